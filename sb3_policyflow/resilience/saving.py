"""What SB3 does not save, though the rest of a run depends on it."""

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch as th


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


class ResumeState(NamedTuple):
    """What a process needs to go on as it would have, besides what SB3 saves.

    Random states, and the running discounted returns of ``VecNormalize``, shape (n_envs,), which it
    leaves out of its own ``save``; None if the model has no such wrapper. Where several processes
    train the model, ``others`` has the states of all but the first, with their last observations
    and episode starts, and ``statistics`` the attributes of ``VecNormalize`` that are running
    statistics: a run that is restarted goes on with them by itself.
    """

    random_states: RandomStates
    normalized_returns: np.ndarray | None
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
