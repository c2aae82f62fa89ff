"""Checks of what the user asks for, made before any work is done."""

import math
import warnings
from collections.abc import Collection, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_policyflow.common.buffers import (
    DictFlowRolloutBuffer,
    FlowRolloutBuffer,
    RecordBufferMixin,
)


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Refuse a value that is not among the choices.

    :raises ValueError: With the choices.
    """
    if value not in choices:
        known = ", ".join(repr(choice) for choice in choices)
        raise ValueError(f"{name} must be one of {known}, got {value!r}.")


def check_count(name: str, value: object, lowest: int) -> None:
    """Refuse what is not a whole number, or too small.

    :raises ValueError: With the lowest value that is allowed.
    """
    if not isinstance(value, Integral) or not int(value) >= lowest:
        raise ValueError(f"{name} must be at least {lowest}, and a whole number, got {value!r}.")


def check_between(name: str, value: object, lowest: float, highest: float = math.inf) -> None:
    """Refuse a number that is out of range; schedules, which are functions, pass.

    :raises ValueError: With the range.
    """
    if callable(value):
        return
    if not isinstance(value, Real) or not lowest <= float(value) <= highest:
        raise ValueError(f"{name} must be a number from {lowest} to {highest}, got {value!r}.")


def check_number(name: str, value: object) -> None:
    """Refuse what is not a finite number.

    :raises ValueError: If it is not.
    """
    if not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}.")


def check_positive(name: str, value: object) -> None:
    """Refuse a number that is not positive.

    :raises ValueError: If it is not.
    """
    if not isinstance(value, Real) or not float(value) > 0:
        raise ValueError(f"{name} must be positive, got {value!r}.")


def check_bounds(name: str, value: object) -> None:
    """Refuse what is not a lowest and a highest number, which may be the same.

    :raises ValueError: If it is not.
    """
    bounds = list(value) if isinstance(value, Sequence) else []
    are_numbers = all(isinstance(bound, Real) for bound in bounds)
    if len(bounds) != 2 or not are_numbers or not bounds[0] <= bounds[1]:
        raise ValueError(f"{name} must be two numbers in order, got {value!r}.")


def check_positive_or_none(name: str, value: object) -> None:
    """Refuse a bound that leaves nothing.

    :raises ValueError: If there is one that is not a positive number.
    """
    if value is not None and (not isinstance(value, Real) or not float(value) > 0):
        raise ValueError(f"{name} must be positive, or None for no bound, got {value!r}.")


def check_policy_class(algorithm: str, policy_class: type[Any], base: type[Any]) -> None:
    """Refuse a policy of another kind.

    :raises ValueError: If ``policy_class`` is not derived from ``base``.
    """
    if not (isinstance(policy_class, type) and issubclass(policy_class, base)):
        raise ValueError(
            f"{algorithm} trains policies derived from {base.__name__}, not "
            f"{getattr(policy_class, '__name__', policy_class)}: use 'MlpFlowPolicy', "
            "'CnnFlowPolicy' or 'MultiInputFlowPolicy', or derive your own from "
            f"{base.__module__}.{base.__name__}."
        )


def check_environment(algorithm: str, env: object, observation_space: object) -> None:
    """Refuse an environment that is missing, or observations that SB3 cannot encode.

    :raises ValueError: If there are no spaces, or a discrete observation does not count from 0.
    """
    if observation_space is None:
        raise ValueError(f"{algorithm} needs an environment to know its spaces: got env={env!r}.")
    parts = observation_space.values() if isinstance(observation_space, spaces.Dict) else []
    for space in (observation_space, *parts):
        if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(space.start):
            raise ValueError(
                f"Discrete observations must count from 0, as SB3 encodes them, but the space is "
                f"{space}: subtract its start in a gymnasium.wrappers.TransformObservation."
            )


def choose_buffer_class(
    algorithm: str, given: type[RolloutBuffer] | None, observation_space: spaces.Space[Any]
) -> type[RecordBufferMixin]:
    """The buffer for an observation space, or the user's own if it keeps a record.

    :raises ValueError: If the user's own keeps none, or is for other observations.
    """
    is_dict = isinstance(observation_space, spaces.Dict)
    default = DictFlowRolloutBuffer if is_dict else FlowRolloutBuffer
    if given is None:
        return default
    if not issubclass(given, RecordBufferMixin):
        raise ValueError(
            f"{algorithm} needs a rollout buffer that keeps how each action was made, which "
            f"{given.__name__} does not: leave out rollout_buffer_class, or derive yours from "
            f"{default.__module__}.{default.__name__}."
        )
    if issubclass(given, DictRolloutBuffer) is not is_dict:
        kind = "dictionaries of observations" if is_dict else "observations that are arrays"
        raise ValueError(
            f"{given.__name__} does not store {kind}, which the environment has: leave out "
            f"rollout_buffer_class, or derive yours from {default.__module__}.{default.__name__}."
        )
    return given


def check_batches(batch_size: int, n_steps: int, n_envs: int, normalize_advantage: bool) -> None:
    """Refuse sizes that SB3's PPO refuses, and warn of those it warns of.

    :raises ValueError: If advantages would be normalized over one sample.
    """
    buffer_size = n_steps * n_envs
    check_count("batch_size", batch_size, 2 if normalize_advantage else 1)
    if normalize_advantage and buffer_size < 2:
        raise ValueError(
            "Advantages cannot be normalized over one sample: n_steps * n_envs must be greater "
            f"than 1, got n_steps={n_steps} and n_envs={n_envs}."
        )
    if buffer_size % batch_size > 0:
        warnings.warn(
            f"batch_size={batch_size} does not divide n_steps * n_envs = {n_steps} * {n_envs} = "
            f"{buffer_size}: the last minibatch of each epoch will have "
            f"{buffer_size % batch_size} samples. Use a factor of {buffer_size}.",
            stacklevel=4,
        )
