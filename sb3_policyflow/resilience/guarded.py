"""An on-policy algorithm of SB3 whose training stops at what would spoil it."""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_policyflow.resilience.collection import (
    Infos,
    Loop,
    PendingBonus,
    StepChecks,
    rollback_statistics,
    terminal_observations,
    time_limits,
)
from sb3_policyflow.resilience.finite import check_rollout
from sb3_policyflow.resilience.training import Training, TrainingAlone
from sb3_policyflow.resilience.workers import watch_workers


class GuardedOnPolicyAlgorithm(OnPolicyAlgorithm):
    """SB3's ``OnPolicyAlgorithm`` with guarded rollouts.

    Rollouts are collected by SB3's loop, in the user's own environment, and checked step by step:
    numbers that are not finite, wrong shapes and dead worker processes stop the training with a
    sentence, before parameters change. Nothing here depends on the policy or its update.
    """

    timeout_bootstrap: str = "terminal"
    """The value with which an episode cut by a time limit continues: that of the "terminal"
    observation, as in SB3, of the "current" one before it, or "none"."""
    allow_nan_observations: bool = False
    """Whether observations may have numbers that are not finite."""

    _callback: BaseCallback | None = None
    """The callback of the rollout that is being collected; its ``locals`` are the loop's."""
    _step_checks: StepChecks
    _training: Training = TrainingAlone()
    """The ``learn`` that is under way; alone outside of it too."""

    @contextmanager
    def _guarded(self) -> Iterator[VecEnv]:
        """A block that uses the environment; names its faults and undoes what can be undone."""
        assert self.env is not None
        self._step_checks = StepChecks(self.env, self.allow_nan_observations)
        watched = watch_workers(self.env, lambda: self.num_timesteps)
        with watched, rollback_statistics(self.get_vec_normalize_env()):
            yield self.env

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self.env is None:
            raise ValueError(
                "The model has no environment to learn in: give one to load, as env, or to set_env."
            )
        with self._guarded():
            prepared = super()._setup_learn(*args, **kwargs)
            self._step_checks.check_observations(self._last_obs, self.num_timesteps)
        return prepared

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect one rollout, or this process' part of it; see SB3.

        :return: False if a callback of any process has stopped the training.
        :raises FloatingPointError: If environment or policy return a number that is not finite.
        :raises RuntimeError: If a worker process of the environment has died.
        :raises ValueError: If the buffer is of another size.
        """
        if n_rollout_steps != rollout_buffer.buffer_size:
            raise ValueError(
                f"n_steps cannot change from {rollout_buffer.buffer_size} to {n_rollout_steps}, "
                "because the rollout buffer was made for it: save the model and load it with "
                f"load(file, n_steps={n_rollout_steps}), or make another one."
            )
        first_timestep = self.num_timesteps
        try:
            with self._guarded():
                self._callback = callback
                loop = super().collect_rollouts
                complete = self._collect(loop, env, callback, rollout_buffer, n_rollout_steps)
        finally:
            self._callback = None
        if complete:
            check_rollout(rollout_buffer, first_timestep)
        return self._training.end_rollout(complete)

    @abstractmethod
    def _collect(
        self, loop: Loop, env: VecEnv, callback: BaseCallback, buffer: RolloutBuffer, n_steps: int
    ) -> bool:
        """Collect a rollout with SB3's ``loop``, or as it must be for another environment."""

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        # SB3's loop calls this after the callbacks and before it bootstraps.
        super()._update_info_buffer(infos, dones)
        if self._callback is None or dones is None:
            return
        step = self._callback.locals
        self._step_checks.check_rewards(step["rewards"], self.num_timesteps)
        self._step_checks.check_observations(step["new_obs"], self.num_timesteps)
        indices = time_limits(infos, dones)
        if indices and hasattr(self.rollout_buffer, "pending_bonus"):
            values = self._timeout_values(infos, indices).flatten().cpu().numpy()
            bonus = self.rollout_buffer.gamma * values
            self.rollout_buffer.pending_bonus = PendingBonus(infos, indices, bonus)

    def _timeout_values(self, infos: Infos, indices: list[int]) -> th.Tensor:
        """Values of the states with which episodes continue beyond their time limits."""
        if self.timeout_bootstrap == "none":
            return th.zeros(len(indices), dtype=th.float32, device="cpu")
        observations: Any = self._last_obs
        if self.timeout_bootstrap == "terminal":
            observations = terminal_observations(infos, indices, self.observation_space)
            kind = "terminal observation"
            self._step_checks.check_observations(observations, self.num_timesteps, kind, indices)
        elif isinstance(observations, dict):
            observations = {key: values[indices] for key, values in observations.items()}
        else:
            observations = observations[indices]
        with th.no_grad():
            return self.policy.predict_values(self.policy.obs_to_tensor(observations)[0])

    def _excluded_save_params(self) -> list[str]:
        own = ("_callback", "_step_checks", "_training")
        return [*super()._excluded_save_params(), *own]
