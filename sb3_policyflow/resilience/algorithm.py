"""An on-policy algorithm of SB3 whose runs resume exactly and stop at what would spoil them."""

import io
import pathlib
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_policyflow.resilience.collection import (
    Infos,
    Loop,
    PendingBonus,
    StepChecks,
    rollback_statistics,
    statistics_of,
    terminal_observations,
    time_limits,
)
from sb3_policyflow.resilience.files import atomic_write, check_archive, opened, saved_attributes
from sb3_policyflow.resilience.finite import check_rollout
from sb3_policyflow.resilience.saving import (
    Observed,
    RandomStates,
    ResumeState,
    check_attributes,
    continue_episodes,
    superseded_attributes,
    takes_former_path,
)
from sb3_policyflow.resilience.training import Training, TrainingAlone
from sb3_policyflow.resilience.workers import watch_workers

SelfResilient = TypeVar("SelfResilient", bound="ResilientOnPolicyAlgorithm")


class ResilientOnPolicyAlgorithm(OnPolicyAlgorithm):
    """SB3's ``OnPolicyAlgorithm`` with guarded rollouts, whole files and exact resume.

    - Rollouts are collected by SB3's loop, in the user's own environment, and checked step by step:
      numbers that are not finite, wrong shapes and dead worker processes stop the training with a
      sentence, before parameters change.
    - ``save`` writes a file completely or not at all, with the states of the random generators
      besides what SB3 saves: parameters, optimizer, counters, progress and last observations.
    - After ``load``, the next ``learn`` continues as if the run had not been interrupted.

    Nothing here depends on the policy or its update.
    """

    timeout_bootstrap: str = "terminal"
    """The value with which an episode cut by a time limit continues: that of the "terminal"
    observation, as in SB3, of the "current" one before it, or "none"."""
    allow_nan_observations: bool = False
    """Whether observations may have numbers that are not finite."""

    former_names: ClassVar[Mapping[str, str]] = {}
    """Present names of attributes by former ones, by which files and ``load`` may know them."""
    former_values: ClassVar[Mapping[str, Any]] = {}
    """Values of attributes that files of earlier versions do not have."""
    unsaved: ClassVar[tuple[str, ...]] = (
        *("_callback", "_step_checks", "_saved_random_states", "_saved_observed"),
        *("rank", "other_resume_states", "_training"),
    )
    """Attributes that no file has."""

    _callback: BaseCallback | None = None
    """The callback of the rollout that is being collected; its ``locals`` are the loop's."""
    _step_checks: StepChecks
    _saved_random_states: RandomStates | None = None
    """Those with which the next ``learn`` continues. A model that only predicts keeps them."""
    rank: int = 0
    """Which of the processes that train this model this one is."""
    other_resume_states: tuple[ResumeState, ...] = ()
    """Those of the processes after the first, which saves the model."""
    run_id: str = ""
    """What tells a run that may be restarted from all others, also in its files."""
    _training: Training = TrainingAlone()
    """The ``learn`` that is under way; alone outside of it too."""
    _saved_observed: Observed | None = None
    """What a file says of the observations in the training that it is from."""

    # Collecting rollouts

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last rollout may end beyond total_timesteps, where SB3's value is negative and a
        # linear schedule with it: a negative learning rate would ascend the loss.
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)

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
        if self._saved_random_states is not None:
            self._saved_random_states.restore(self.device)
            self._saved_random_states = None
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

    # Saving and loading

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save the model, and all that its training depends on, in a zip file; see SB3.

        The file is written completely or not at all: if the process is killed meanwhile, the old
        file remains. Where several processes train the model, rank 0 writes it, with the random
        states of all from before the rollout that is under way, or after the last one.

        :param path: Where to save it, or a file opened for writing.
        :param exclude: Attributes not to save, such as "resume_state".
        :param include: Attributes to save that SB3 leaves out.
        """
        self._prepare_saving()
        if self.rank > 0:
            return
        # SB3 saves the attributes that it finds, the last observations of this process too.
        state = self.own_resume_state()._replace(last_obs=None, last_episode_starts=None)
        self.resume_state = state._replace(
            observed=self.observed(), others=self.other_resume_states
        )
        try:
            if isinstance(path, (str, pathlib.Path)):
                with atomic_write(path, suffix="zip") as file:
                    super().save(file, exclude, include)  # type: ignore[arg-type]  # as open_path
            else:
                super().save(path, exclude, include)
        finally:
            del self.resume_state

    @abstractmethod
    def _prepare_saving(self) -> None:
        """Bring up to date what a file has."""

    def own_resume_state(self) -> ResumeState:
        """What this process needs to go on as it would have."""
        normalize = self.get_vec_normalize_env()
        return ResumeState(
            random_states=self._saved_random_states or RandomStates.now(self.device),
            normalized_returns=None if normalize is None else normalize.returns.copy(),
            last_obs=self._last_obs,
            last_episode_starts=self._last_episode_starts,
            statistics=statistics_of(normalize),
        )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self.unsaved]

    @classmethod
    @takes_former_path
    def load(
        cls: type[SelfResilient],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        reseed: bool = False,
        **kwargs: Any,
    ) -> SelfResilient:
        """Load a model; see SB3.

        The next ``learn`` restores the random generators of torch, numpy and Python as they were
        when the model was saved, so that training continues as it would have. Environments are
        seeded with the model's seed and reset, as in SB3, unless ``force_reset`` is False.

        :param path: The file, or one opened for reading. An attribute among ``kwargs`` may have
            this name too, if it is a former one and the file is given by position.
        :param env: The environment in which to continue.
        :param device: Where to put the model.
        :param custom_objects: Attributes to take instead of the saved ones.
        :param print_system_info: Whether to print on what system the model was saved.
        :param force_reset: Whether training starts with new episodes. False continues from the last
            observations, which is right only if ``env`` is in the state in which it was.
        :param reseed: Whether to leave the random generators as the model's seed, if it has one,
            sets them, as SB3 does. So does a ``seed`` among ``kwargs``.
        :param kwargs: Attributes to change.
        :raises ValueError: If the file is no saved model, the environment does not fit it, or an
            attribute is given under two names.
        :raises TypeError: If there is no attribute of a name among ``kwargs``.
        """
        with opened(path, suffix="zip") as file:
            check_archive(file, path, members=("data", "policy.pth"))
            saved = saved_attributes(file)
            check_attributes(cls, kwargs, saved)
            missing = {k: v for k, v in cls.former_values.items() if k not in saved}
            superseded = superseded_attributes(cls, kwargs, saved)
            custom_objects = {**(custom_objects or {}), **superseded}
            kwargs = {**missing, **kwargs}
            model = super().load(
                file, env, device, custom_objects, print_system_info, force_reset, **kwargs
            )
        # Files of SB3's own algorithms have none.
        first: ResumeState | None = model.__dict__.pop("resume_state", None)
        state = None if first is None else first.of_rank(model.rank)
        if not force_reset:
            continue_episodes(model, state)
        model._saved_observed = None if first is None else first.what_was_observed()
        if state is not None and not reseed and "seed" not in kwargs:
            model._saved_random_states = state.random_states
        return model

    def observed(self) -> Observed | None:
        """What the policy observed in training: whether it was normalized, and the space before.

        :return: None if neither an environment nor a file says.
        """
        normalize = self.get_vec_normalize_env()
        if normalize is not None:
            return Observed(normalize.norm_obs, normalize.venv.observation_space)
        if self._saved_observed is None and self.env is not None:
            return Observed(False, self.observation_space)
        return self._saved_observed

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the generators; see SB3. Those that ``load`` has found are forgotten.

        :param seed: That of rank 0 and its first environment, from which the other processes'
            environments go on counting; nothing happens without one.
        """
        if seed is not None and self.rank > 0:
            seed = (seed + self.rank * self.n_envs) % 2**32
        super().set_random_seed(seed)
        if seed is not None:
            self._saved_random_states = None

    @property
    def remaining_timesteps(self) -> int:
        """Timesteps to the end of the ``learn`` that the model was saved in.

        ``model.learn(model.remaining_timesteps, reset_num_timesteps=False)`` completes it.
        """
        return max(self._total_timesteps - self.num_timesteps, 0)
