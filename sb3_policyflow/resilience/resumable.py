"""An on-policy algorithm of SB3 whose files are whole and whose runs resume exactly."""

import io
import pathlib
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_policyflow.resilience.collection import statistics_of
from sb3_policyflow.resilience.files import atomic_write, check_archive, opened, saved_attributes
from sb3_policyflow.resilience.saving import (
    Observed,
    RandomStates,
    ResumeState,
    check_attributes,
    continue_episodes,
    superseded_attributes,
    takes_former_path,
)

SelfResumable = TypeVar("SelfResumable", bound="ResumableOnPolicyAlgorithm")


class ResumableOnPolicyAlgorithm(OnPolicyAlgorithm):
    """SB3's ``OnPolicyAlgorithm`` with whole files and exact resume.

    - ``save`` writes a file completely or not at all, with the states of the random generators
      besides what SB3 saves: parameters, optimizer, counters, progress and last observations.
    - After ``load``, the next ``learn`` continues as if the run had not been interrupted.

    Nothing here depends on the policy or its update.
    """

    former_names: ClassVar[Mapping[str, str]] = {}
    """Present names of attributes by former ones, by which files and ``load`` may know them."""
    former_values: ClassVar[Mapping[str, Any]] = {}
    """Values of attributes that files of earlier versions do not have."""

    rank: int = 0
    """Which of the processes that train this model this one is."""
    other_resume_states: tuple[ResumeState, ...] = ()
    """Those of the processes after the first, which saves the model."""
    run_id: str = ""
    """What tells a run that may be restarted from all others, also in its files."""
    _saved_random_states: RandomStates | None = None
    """Those with which the next ``learn`` continues. A model that only predicts keeps them."""
    _saved_observed: Observed | None = None
    """What a file says of the observations in the training that it is from."""

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self._saved_random_states is not None:
            self._saved_random_states.restore(self.device)
            self._saved_random_states = None
        return super()._setup_learn(*args, **kwargs)

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
        own = ("rank", "other_resume_states", "_saved_random_states", "_saved_observed")
        return [*super()._excluded_save_params(), *own]

    @classmethod
    @takes_former_path
    def load(
        cls: type[SelfResumable],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        reseed: bool = False,
        **kwargs: Any,
    ) -> SelfResumable:
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
