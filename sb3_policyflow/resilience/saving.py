"""Saving all that a run depends on, and going on from it exactly."""

import io
import pathlib
import random
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv

from sb3_policyflow.resilience.files import check_archive, written_whole

SelfSaving = TypeVar("SelfSaving", bound="SavingMixin")


class RandomStates(NamedTuple):
    """The states of the global generators that training draws from; CUDA's where it is in use."""

    torch: th.Tensor
    numpy: Any
    python: Any
    cuda: th.Tensor | None

    @classmethod
    def now(cls, device: th.device) -> "RandomStates":
        """The present states.

        :param device: Where the model is.
        """
        cuda = th.cuda.get_rng_state(device) if device.type == "cuda" else None
        return cls(th.get_rng_state(), np.random.get_state(legacy=False), random.getstate(), cuda)

    def restore(self, device: th.device) -> None:
        """Make these the present states."""
        th.set_rng_state(self.torch)
        np.random.set_state(self.numpy)
        random.setstate(self.python)
        if self.cuda is not None and device.type == "cuda":
            th.cuda.set_rng_state(self.cuda, device)


@contextmanager
def random_states_kept(device: th.device) -> Iterator[None]:
    """Whatever the block draws, training goes on as if it had drawn nothing."""
    states = RandomStates.now(device)
    try:
        yield
    finally:
        states.restore(device)


class ResumeState(NamedTuple):
    """What SB3 does not save, though the rest of a run depends on it.

    ``normalized_returns`` are the running discounted returns of ``VecNormalize``, shape (n_envs,),
    which its own ``save`` leaves out.
    """

    random_states: RandomStates
    normalized_returns: np.ndarray | None


class SavingMixin(OnPolicyAlgorithm):
    """SB3's ``save`` and ``load``, so that a run goes on exactly and a file is never half written.

    SB3 saves parameters, optimizer, counters, progress, and the last observations; here the states
    of the random generators come on top.
    """

    _saved_random_states: RandomStates | None = None
    """Those that the next ``learn`` goes on with. A model that only acts leaves them alone."""

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save the model, and all that its training depends on, in a zip file; see SB3.

        The file appears whole or not at all: a process that is killed meanwhile leaves the old one.

        :param path: Where to save it, or a file opened for writing.
        :param exclude: Attributes not to save, such as "resume_state".
        :param include: Attributes to save that SB3 leaves out.
        """
        # SB3 saves what it finds among the attributes.
        self.resume_state = self._resume_state()
        try:
            if isinstance(path, (str, pathlib.Path)):
                with written_whole(path, suffix="zip") as file:
                    super().save(file, exclude, include)  # type: ignore[arg-type]  # as open_path
            else:
                super().save(path, exclude, include)
        finally:
            del self.resume_state

    def _resume_state(self) -> ResumeState:
        normalize = self.get_vec_normalize_env()
        return ResumeState(
            random_states=self._saved_random_states or RandomStates.now(self.device),
            normalized_returns=None if normalize is None else normalize.returns.copy(),
        )

    @classmethod
    def load(
        cls: type[SelfSaving],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        reseed: bool = False,
        **kwargs: Any,
    ) -> SelfSaving:
        """Load a model; see SB3.

        The next ``learn`` puts the random generators of torch, numpy and Python back to where they
        were when the model was saved, so that training goes on as it would have. Environments are
        seeded with the model's seed and reset, as in SB3, unless ``force_reset`` is False.

        :param path: The file, or one opened for reading.
        :param env: The environment to go on with.
        :param device: Where to put the model.
        :param custom_objects: Attributes to take instead of the saved ones.
        :param print_system_info: Whether to print on what system the model was saved.
        :param force_reset: Whether training starts with new episodes. False goes on from the last
            observations, which is right only if ``env`` is in the state it was in.
        :param reseed: Whether to leave the random generators as the model's seed, if it has one,
            starts them anew, as SB3 does. So does a ``seed`` among ``kwargs``.
        :param kwargs: Attributes to change.
        :raises ValueError: If the file is no saved model, or the environment does not fit it.
        """
        with _opened(path) as file:
            check_archive(file, path, members=("data", "policy.pth"))
            model = super().load(
                file, env, device, custom_objects, print_system_info, force_reset, **kwargs
            )
        # Files of SB3's own have none.
        state: ResumeState | None = model.__dict__.pop("resume_state", None)
        if not force_reset:
            model._go_on_in_env(state)
        if state is not None and not reseed and "seed" not in kwargs:
            model._saved_random_states = state.random_states
        return model

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self._saved_random_states is not None:
            self._saved_random_states.restore(self.device)
            self._saved_random_states = None
        return super()._setup_learn(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_saved_random_states"]

    def _go_on_in_env(self, state: ResumeState | None) -> None:
        """Fit an environment that is not reset to the last observations."""
        if self.env is None or self._last_episode_starts is None:
            return
        n_saved = len(self._last_episode_starts)
        if n_saved != self.n_envs:
            raise ValueError(
                f"The model was saved with {n_saved} environments and cannot go on in the middle "
                f"of their episodes with {self.n_envs}: leave out force_reset=False."
            )
        normalize = self.get_vec_normalize_env()
        if normalize is not None and state is not None and state.normalized_returns is not None:
            normalize.returns = state.normalized_returns.copy()

    @property
    def remaining_timesteps(self) -> int:
        """Timesteps to the end of the ``learn`` that the model was saved in.

        ``model.learn(model.remaining_timesteps, reset_num_timesteps=False)`` finishes it.
        """
        return max(self._total_timesteps - self.num_timesteps, 0)


@contextmanager
def _opened(path: str | pathlib.Path | io.BufferedIOBase) -> Iterator[Any]:
    """A file to read; one that the user has opened stays open."""
    file = open_path(path, "r", suffix="zip")
    try:
        yield file
    finally:
        if isinstance(path, (str, pathlib.Path)):
            file.close()
