"""What happens between the environment and SB3's ``collect_rollouts``."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

Infos = list[dict[str, Any]]


class RolloutVecEnv(VecEnvWrapper):
    """Guards one rollout against numbers that are not finite, and bootstraps time limits in batch.

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

    def reset(self) -> VecEnvObs:
        """Reset the environments."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Finish a step.

        :raises FloatingPointError: If an observation or a reward is not finite.
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        self._timestep += self.num_envs
        self._check_finite("reward", rewards)
        observations: Any = obs if isinstance(obs, dict) else {"observation": obs}
        for name, values in observations.items():
            self._check_finite(name, values)
        self._rewards = rewards
        return obs, rewards, dones, list(infos)

    def bootstrap_timeouts(
        self, infos: Infos, predict_values: Callable[[list[int]], th.Tensor], gamma: float
    ) -> None:
        """Add the discounted value of what came after each time limit to the step's rewards.

        :param infos: The list that :meth:`step_wait` returned, changed in place.
        :param predict_values: Values of the states at the time limits of the environments with
            these indices, shape (n, 1).
        :param gamma: Discount factor.
        """
        truncated = [index for index, info in enumerate(infos) if _is_timeout(info)]
        if not truncated:
            return
        values = predict_values(truncated).flatten().cpu().numpy()
        self._rewards[truncated] += gamma * values
        for index in truncated:
            infos[index] = {**infos[index], "TimeLimit.truncated": False}

    def _check_finite(self, name: str, values: np.ndarray) -> None:
        # The sum is finite unless a number is not, or, which is looked into, it overflows.
        if values.dtype.kind == "f" and not math.isfinite(values.sum()):
            finite = np.isfinite(values).reshape(self.num_envs, -1).all(axis=1)
            if finite.all():
                return
            raise FloatingPointError(
                f"The environment returned a {name} that is not finite at timestep "
                f"{self._timestep}, in environment {np.flatnonzero(~finite)[0]}. Training has "
                "stopped before its parameters were touched: mend the environment, or find the "
                "cause with stable_baselines3.common.vec_env.VecCheckNan."
            )


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


class CollectionMixin(OnPolicyAlgorithm):
    """SB3's collection of rollouts, through a :class:`RolloutVecEnv`."""

    timeout_bootstrap: str
    _collector: RolloutVecEnv | None = None

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect one rollout; see SB3.

        :raises FloatingPointError: If the environment returns a number that is not finite.
        """
        self._collector = RolloutVecEnv(env, self.num_timesteps)
        try:
            return super().collect_rollouts(
                self._collector, callback, rollout_buffer, n_rollout_steps
            )
        finally:
            self._collector = None

    def _update_info_buffer(self, infos: Infos, dones: np.ndarray | None = None) -> None:
        # SB3's loop calls this after the callbacks and before it bootstraps.
        super()._update_info_buffer(infos, dones)
        if self._collector is not None:
            self._collector.bootstrap_timeouts(
                infos, lambda indices: self._timeout_values(infos, indices), self.gamma
            )

    def _timeout_values(self, infos: Infos, indices: list[int]) -> th.Tensor:
        """Values of the states with which episodes go on behind their time limits."""
        if self.timeout_bootstrap == "none":
            return th.zeros(len(indices))
        if self.timeout_bootstrap == "current":
            observations = _rows(self._last_obs, indices)
        else:
            observations = terminal_observations(infos, indices)
        with th.no_grad():
            return self.policy.predict_values(self.policy.obs_to_tensor(observations)[0])

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_collector"]


def _rows(observations: Any, indices: list[int]) -> Any:
    if isinstance(observations, dict):
        return {key: values[indices] for key, values in observations.items()}
    return observations[indices]
