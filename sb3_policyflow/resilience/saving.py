"""What SB3 does not save, though the rest of a run depends on it."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces


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
    """

    random_states: RandomStates
    normalized_returns: np.ndarray | None
    observed: Observed | None = None

    def what_was_observed(self) -> Observed | None:
        """What the policy observed; None if it was what the policy's own space says."""
        if self.observed is None and self.normalized_returns is not None:
            return Observed(None, None)
        return self.observed
