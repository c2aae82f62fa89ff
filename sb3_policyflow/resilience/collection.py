"""What is checked in a rollout, and how its time limits are bootstrapped.

SB3's own loop collects the rollout from the user's own environment: nothing stands in between. The
checks are made after each step, when the callbacks have seen it.
"""

from collections.abc import Callable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_policyflow.resilience.finite import check_finite

Infos = Sequence[Any]
Loop = Callable[..., bool]
"""SB3's ``collect_rollouts``, or another with its arguments."""
ADVICE = "fix the environment, or find the cause with stable_baselines3.common.vec_env.VecCheckNan"
TRUNCATED = "TimeLimit.truncated"


class StepChecks:
    """Refuses rewards and observations that cannot be learned from.

    :param env: The training environment.
    :param allow_nan_observations: Whether observations may have numbers that are not finite, if
        ``VecNormalize`` does not spread them over all environments.
    """

    def __init__(self, env: VecEnv, allow_nan_observations: bool = False) -> None:
        self._space = env.observation_space
        self._normalize = unwrap_vec_normalize(env)
        self._allow_nan = allow_nan_observations

    def check_rewards(self, rewards: np.ndarray, timestep: int) -> None:
        """Refuse rewards, shape (n_envs,), that are not finite.

        :param rewards: The rewards of a step.
        :param timestep: When, for the message.
        :raises FloatingPointError: If one is not finite.
        """
        what = "The environment's reward"
        rewards = np.asarray(rewards, dtype=np.float64)
        if self._normalize is not None and not np.isfinite(rewards).all():
            # It has spread one environment's number over all of them.
            check_finite(self._normalize.get_original_reward(), what, timestep, ADVICE)
        check_finite(rewards, what, timestep, ADVICE)

    def check_observations(
        self,
        obs: Any,
        timestep: int,
        kind: str = "observation",
        indices: list[int] | None = None,
    ) -> None:
        """Refuse observations that cannot be learned from.

        :param obs: One row for each environment.
        :param timestep: When, for the message.
        :param kind: What they are, for the message.
        :param indices: The environments, if not all.
        :raises FloatingPointError: If one is not finite.
        :raises ValueError: If one has not the shape of its space.
        """
        normalize = self._normalize if indices is None else None
        for name, values, space in _named(kind, obs, self._space):
            what = f"The environment's {name}"
            if values.shape[1:] != space.shape:
                raise ValueError(
                    f"{what} has shape {values.shape[1:]} at timestep {timestep}, but its space "
                    f"has {space.shape}: change one of them, with the help of "
                    "stable_baselines3.common.env_checker.check_env."
                )
            if np.isfinite(values).all():
                continue
            # VecNormalize spreads one environment's number over all of them.
            read = obs if normalize is None else normalize.get_original_obs()
            originals = {other: numbers for other, numbers, _ in _named(kind, read, self._space)}
            if self._allow_nan:
                spread = np.where(np.isfinite(originals[name]), values, 0.0)
                advice = "keep NaN out of VecNormalize, by its norm_obs or norm_obs_keys"
                check_finite(spread, f"The normalized {name}", timestep, advice, indices)
            else:
                check_finite(originals[name], what, timestep, ADVICE, indices)
                check_finite(values, what, timestep, ADVICE, indices)


def _named(
    kind: str, obs: Any, space: spaces.Space[Any]
) -> list[tuple[str, np.ndarray, spaces.Space[Any]]]:
    """Arrays of observations, what to call them, and their spaces."""
    if not isinstance(obs, dict):
        return [(kind, np.asarray(obs), space)]
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    return [
        (f"{kind} {key!r}", np.asarray(obs[key]), part) for key, part in parts.items() if key in obs
    ]


class PendingBonus:
    """The discounted values with which episodes continue beyond their time limits, for one step.

    SB3's loop asks for these values one by one and adds them to the environment's own rewards. Here
    they are asked for together, and the buffer adds them to a copy of the rewards. In between the
    loop must not find the time limits: their marks are taken out of the infos and put back.

    :param infos: One mapping for each environment.
    :param indices: The environments whose time limits have cut an episode.
    :param bonus: What is to be added to their rewards, shape (n,).
    """

    def __init__(self, infos: Infos, indices: list[int], bonus: np.ndarray) -> None:
        self._infos, self._indices, self._bonus = infos, indices, bonus
        self._marks = [infos[index][TRUNCATED] for index in indices]
        for index in indices:
            infos[index][TRUNCATED] = False

    def settle(self, rewards: np.ndarray) -> np.ndarray:
        """Put the marks back.

        :param rewards: The environment's, shape (n_envs,), which are left as they are.
        :return: A copy with the bonus, in single precision or better.
        """
        for index, mark in zip(self._indices, self._marks, strict=True):
            self._infos[index][TRUNCATED] = mark
        own = np.array(rewards, dtype=np.result_type(np.asarray(rewards).dtype, np.float32))
        own[self._indices] += self._bonus
        return own


def time_limits(infos: Infos, dones: np.ndarray) -> list[int]:
    """The environments whose episodes SB3's loop would bootstrap.

    :param infos: One mapping for each environment.
    :param dones: Whether each episode has ended, shape (n_envs,).
    """
    return [
        index
        for index in np.flatnonzero(dones).tolist()
        if infos[index].get("terminal_observation") is not None
        and infos[index].get(TRUNCATED, False)
        and isinstance(infos[index], MutableMapping)
    ]


def terminal_observations(infos: Infos, indices: list[int], space: spaces.Space[Any]) -> Any:
    """The terminal observations of some environments as one batch.

    :param infos: One mapping for each environment.
    :param indices: The environments.
    :param space: The space of the observations. As SB3 does, they are brought into its shape.
    :return: An array (n, ...), or a dictionary of such arrays.
    """

    def batch(observations: list[Any], part: spaces.Space[Any]) -> np.ndarray:
        arrays = np.stack([np.asarray(obs) for obs in observations])
        shape = (len(arrays), *(part.shape or ()))
        return arrays.reshape(shape) if arrays.size == np.prod(shape) else arrays

    observations = [infos[index]["terminal_observation"] for index in indices]
    if isinstance(space, spaces.Dict):
        return {key: batch([obs[key] for obs in observations], space[key]) for key in space.spaces}
    return batch(observations, space)


def statistics_of(normalize: VecNormalize | None) -> dict[str, Any]:
    """The attributes of ``VecNormalize`` that are running statistics, as they are.

    :param normalize: The wrapper; without one there are none.
    """
    names = ("obs_rms", "ret_rms")
    return {name: getattr(normalize, name) for name in names if hasattr(normalize, name)}


@contextmanager
def rollback_statistics(normalize: VecNormalize | None) -> Iterator[None]:
    """Undo what a number that is not finite has done to running statistics.

    ``VecNormalize`` takes it in before anyone sees it, and would keep it for ever.

    :param normalize: The environment's wrapper, if it has one.
    """
    kept = deepcopy(statistics_of(normalize))
    if normalize is not None:
        kept["returns"] = normalize.returns.copy()
    try:
        yield
    except FloatingPointError:
        if normalize is not None:
            vars(normalize).update(kept)
        raise
