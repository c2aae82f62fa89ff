"""What happens between the environment and SB3's ``collect_rollouts``."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
    unwrap_vec_normalize,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_policyflow.resilience.finite import check_finite
from sb3_policyflow.resilience.workers import wait_for_workers

Infos = list[dict[str, Any]]
ADVICE = "fix the environment, or find the cause with stable_baselines3.common.vec_env.VecCheckNan"


class RolloutVecEnv(VecEnvWrapper):
    """Guards one rollout against what would spoil it, and bootstraps time limits in batch.

    SB3's loop asks for the value of each truncated environment's last observation one by one. Here
    they are asked for together, after the callbacks have seen the true rewards and infos and before
    the loop looks at them, and the loop finds nothing left to do.

    :param venv: The training environment.
    :param first_timestep: Timesteps before this rollout, for error messages.
    """

    def __init__(self, venv: VecEnv, first_timestep: int = 0) -> None:
        super().__init__(venv)
        self._timestep = first_timestep
        self._rewards = np.zeros(0)
        self._innermost = self.unwrapped
        self._normalize = unwrap_vec_normalize(self)

    def reset(self) -> VecEnvObs:
        """Reset the environments."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Start a step.

        :raises FloatingPointError: If an action is not finite.
        """
        self._timestep += self.num_envs
        advice = "load an earlier checkpoint and lower the learning rate"
        check_finite(actions, "The policy's action", self._timestep, advice)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish a step.

        :raises FloatingPointError: If an observation or a reward is not finite.
        :raises ValueError: If an observation has not the shape of its space.
        :raises EOFError: If a worker process of the environment has died.
        """
        wait_for_workers(self._innermost)
        obs, rewards, dones, infos = self.venv.step_wait()
        self.check_rewards(rewards)
        self.check_observations(obs)
        self._rewards = rewards
        return obs, rewards, dones, list(infos)

    def check_rewards(self, rewards: np.ndarray) -> None:
        """Refuse rewards, shape (n_envs,), that are not finite.

        :raises FloatingPointError: If one is not.
        """
        normalize = self._normalize
        if normalize is not None and not np.isfinite(rewards).all():
            # It has spread one environment's number over all of them.
            self._check_finite("reward", normalize.get_original_reward())
        self._check_finite("reward", rewards)

    def check_observations(
        self, obs: Any, kind: str = "observation", indices: list[int] | None = None
    ) -> None:
        """Refuse observations that cannot be learned from.

        :param obs: One row for each environment.
        :param kind: What they are, for the message.
        :param indices: The environments, if not all.
        :raises FloatingPointError: If one is not finite.
        :raises ValueError: If one has not the shape of its space.
        """
        normalize = self._normalize if indices is None else None
        for name, values, space in _named(kind, obs, self.observation_space):
            self._check_shape(name, values, space)
            if normalize is not None and not np.isfinite(values).all():
                for original, numbers, _ in _named(kind, normalize.get_original_obs(), space):
                    self._check_finite(original, numbers)
            self._check_finite(name, values, indices)

    def bootstrap_timeouts(
        self,
        infos: Infos,
        dones: np.ndarray,
        predict_values: Callable[[list[int]], th.Tensor],
        gamma: float,
    ) -> None:
        """Add the discounted value of what came after each time limit to the step's rewards.

        :param infos: The list that :meth:`step_wait` returned, changed in place.
        :param dones: Whether each episode has ended, shape (n_envs,).
        :param predict_values: Values of the states at the time limits of the environments with
            these indices, shape (n, 1).
        :param gamma: Discount factor.
        """
        truncated = [i for i in np.flatnonzero(dones).tolist() if _is_timeout(infos[i])]
        if not truncated:
            return
        values = predict_values(truncated).flatten().cpu().numpy()
        self._rewards[truncated] += gamma * values
        for index in truncated:
            infos[index] = {**infos[index], "TimeLimit.truncated": False}

    def _check_finite(
        self, name: str, values: np.ndarray, indices: list[int] | None = None
    ) -> None:
        check_finite(values, f"The environment's {name}", self._timestep, ADVICE, indices)

    def _check_shape(self, name: str, values: np.ndarray, space: spaces.Space[Any]) -> None:
        if values.shape[1:] != space.shape:
            raise ValueError(
                f"The environment's {name} has shape {values.shape[1:]} at timestep "
                f"{self._timestep}, but its space has {space.shape}: mend one of them, with the "
                "help of stable_baselines3.common.env_checker.check_env."
            )


def _named(
    kind: str, obs: Any, space: spaces.Space[Any]
) -> list[tuple[str, np.ndarray, spaces.Space[Any]]]:
    """Arrays of observations, what to call them, and their spaces."""
    if not isinstance(obs, dict):
        return [(kind, obs, space)]
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    return [(f"{kind} {key!r}", values, parts.get(key, space)) for key, values in obs.items()]


def _is_timeout(info: dict[str, Any]) -> bool:
    """The condition under which SB3's loop bootstraps, for an environment that is done."""
    truncated = bool(info.get("TimeLimit.truncated", False))
    return truncated and info.get("terminal_observation") is not None


def terminal_observations(infos: Infos, indices: list[int]) -> Any:
    """The terminal observations of some environments as one batch.

    :param infos: One dictionary for each environment.
    :param indices: The environments.
    :return: An array (n, ...), or a dictionary of such arrays.
    """
    observations = [infos[index]["terminal_observation"] for index in indices]
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)


@contextmanager
def rollback_statistics(normalize: VecNormalize | None) -> Iterator[None]:
    """Undo what a number that is not finite has done to running statistics.

    ``VecNormalize`` takes it in before anyone sees it, and would never be rid of it.

    :param normalize: The environment's wrapper, if it has one.
    """
    names = ("obs_rms", "ret_rms", "returns")
    kept = {name: deepcopy(getattr(normalize, name, None)) for name in names}
    try:
        yield
    except FloatingPointError:
        if normalize is not None:
            vars(normalize).update(kept)
        raise
