"""What a command cannot do, said before it starts."""

import argparse
import math
from collections.abc import Callable

import gymnasium as gym

from sb3_policyflow.envs import PLAYGROUND, ensure_registered
from sb3_policyflow.envs.playground.tasks import require_task
from sb3_policyflow.envs.point_maze import ENV_ID as POINT_MAZE
from sb3_policyflow.envs.point_maze import medium_maze


class BenchmarkError(ValueError):
    """A command cannot do what it was asked for; the message says what to do."""


def at_least(least: float, kind: type[int] | type[float] = int) -> Callable[[str], float]:
    """A type for ``argparse``: finite numbers that are not less than a least one.

    >>> at_least(1)("3"), at_least(1, float)("1e6")
    (3, 1000000.0)

    :param least: The least number.
    :param kind: The type of the numbers.
    """

    def number(text: str) -> float:
        value = kind(text)
        if not least <= value < math.inf:
            raise argparse.ArgumentTypeError(f"must be at least {least}, got {text}")
        return value

    return number


def require_env(env_id: str) -> None:
    """See whether an environment can be made, before trainings are started in it.

    :param env_id: Its id.
    :raises BenchmarkError: If there is none of this id, or the extra that it needs is missing.
    """
    try:
        ensure_registered(env_id)
        gym.spec(env_id)
        # The ids of this package's own environments are registered without the extras.
        if env_id.startswith(PLAYGROUND):
            require_task(env_id.removeprefix(PLAYGROUND).removesuffix("-v0"))
        elif env_id == POINT_MAZE:
            medium_maze()
    except gym.error.Error as error:
        raise BenchmarkError(str(error)) from error
