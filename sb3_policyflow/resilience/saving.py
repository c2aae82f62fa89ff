"""What SB3 does not save, though the rest of a run depends on it; and what ``load`` may change."""

import functools
import inspect
import random
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_policyflow.hints import did_you_mean, refuse_both_names

P = ParamSpec("P")
T = TypeVar("T")
SUPERSEDED = object()
"""What a file's attribute has under its former name, where ``load`` changes the present one."""


class RandomStates(NamedTuple):
    """States of the global generators that training draws from; CUDA's if the model is on it."""

    torch: th.Tensor
    numpy: Any
    python: Any
    cuda: th.Tensor | None

    @classmethod
    def now(cls, device: th.device) -> "RandomStates":
        """The current states, for a model on this device."""
        cuda = th.cuda.get_rng_state(device) if device.type == "cuda" else None
        return cls(th.get_rng_state(), np.random.get_state(legacy=False), random.getstate(), cuda)

    def restore(self, device: th.device) -> None:
        """Make these the current states."""
        th.set_rng_state(self.torch)
        np.random.set_state(self.numpy)
        random.setstate(self.python)
        if self.cuda is not None and device.type == "cuda":
            th.cuda.set_rng_state(self.cuda, device)


@contextmanager
def preserve_rng_state(device: th.device) -> Iterator[None]:
    """Restore the random generators after the block, as if it had drawn nothing."""
    states = RandomStates.now(device)
    try:
        yield
    finally:
        states.restore(device)


class Observed(NamedTuple):
    """What a policy observed in training.

    ``is_normalized`` says whether ``VecNormalize`` normalized observations, None if the file does
    not say (version 0.1.0); ``space`` is that of the environment's own observations, if known.
    """

    is_normalized: bool | None
    space: spaces.Space[Any] | None


class ResumeState(NamedTuple):
    """Random states, and what ``VecNormalize`` leaves out of its own ``save``.

    ``normalized_returns`` are its running discounted returns, shape (n_envs,); None without it.
    Where several processes train the model, ``others`` has the states of all but the first, with
    their last observations and episode starts. A run that is restarted goes on by itself with
    ``statistics``, the attributes of ``VecNormalize`` that are running statistics.
    """

    random_states: RandomStates
    normalized_returns: np.ndarray | None
    observed: Observed | None = None
    last_obs: Any = None
    last_episode_starts: np.ndarray | None = None
    others: "tuple[ResumeState, ...]" = ()
    statistics: Mapping[str, Any] | None = None

    def of_rank(self, rank: int) -> "ResumeState | None":
        """What a process finds in the file; None if fewer have trained the model.

        :param rank: Its number.
        """
        states = (self, *self.others)
        return states[rank] if rank < len(states) else None

    def what_was_observed(self) -> Observed | None:
        """What the policy observed; None if the file does not say whether there was a wrapper."""
        if self.observed is None and self.normalized_returns is not None:
            return Observed(None, None)
        return self.observed


def continue_episodes(model: Any, state: ResumeState | None) -> None:
    """Check an environment that is not reset against the last observations.

    :param model: A model that has just been loaded.
    :param state: What the file has for this process.
    :raises ValueError: If the environment cannot continue in the middle of its episodes.
    """
    if model.rank > 0:
        if state is None or state.last_episode_starts is None:
            raise ValueError(
                f"The file has no last observations of rank {model.rank}, which cannot "
                "continue in the middle of its episodes: leave out force_reset=False."
            )
        model._last_obs, model._last_episode_starts = state.last_obs, state.last_episode_starts
    if model.env is None or model._last_episode_starts is None:
        return
    n_saved = len(model._last_episode_starts)
    if n_saved != model.n_envs:
        raise ValueError(
            f"The model was saved with {n_saved} environments and cannot continue in the "
            f"middle of their episodes with {model.n_envs}: leave out force_reset=False."
        )
    normalize = model.get_vec_normalize_env()
    if normalize is not None and state is not None and state.normalized_returns is not None:
        normalize.returns = state.normalized_returns.copy()


def check_attributes(algorithm: type[Any], given: Collection[str], saved: Collection[str]) -> None:
    """Refuse attributes for ``load`` to change that no model has.

    :param algorithm: The class of the model.
    :param given: Their names.
    :param saved: Names of the attributes that are in the file.
    :raises TypeError: With the nearest names.
    """
    arguments = inspect.signature(algorithm).parameters.keys() - {"policy", "env"}
    known = {*arguments, *algorithm.former_names, *saved}
    for name in given:
        if name not in known and not hasattr(algorithm, name):
            meant = did_you_mean(name, known, "the file has no such attribute.")
            raise TypeError(f"{algorithm.__name__}.load has no {name!r} to change: {meant}")


def superseded_attributes(
    algorithm: type[Any], given: Mapping[str, Any], saved: Collection[str]
) -> dict[str, Any]:
    """What a file has under a former name, and ``load`` gets under the present one.

    :param algorithm: The class of the model.
    :param given: Attributes for ``load`` to change.
    :param saved: Names of the attributes that are in the file.
    :return: Former names, with :data:`SUPERSEDED` as their value.
    :raises ValueError: If an attribute is given under both names.
    """
    former_names: Mapping[str, str] = algorithm.former_names
    refuse_both_names(given, former_names)
    return {
        former: SUPERSEDED
        for former, present in former_names.items()
        if former in saved and former not in given and present.partition(".")[0] in given
    }


def takes_former_path(load: Callable[P, T]) -> Callable[P, T]:
    """Let ``load`` change an attribute that was called ``path``, as its first parameter is."""

    @functools.wraps(load)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        cls: Any = args[0]
        is_positional = len(args) > 1 and "path" in kwargs
        present = cls.former_names.get("path") if is_positional else None
        if present is not None:
            refuse_both_names(kwargs, {"path": present})
            kwargs[present] = kwargs.pop("path")
        return load(*args, **kwargs)

    return wrapped
