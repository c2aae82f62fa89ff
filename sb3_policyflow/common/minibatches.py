"""Transitions as an update takes them, a few at a time."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_policyflow.common.tree import are_small, rows, tensors

SHUFFLED_AT_ONCE = 2**26
"""Bytes of a rollout of small rows up to which a shuffled copy of it is made for each epoch."""


class FlowRolloutBufferSamples(NamedTuple):
    """Transitions with the record of how each action was made; n samples along the first axis.

    ``record`` is what the policy's ``forward`` returned, a NamedTuple of tensors (n, ...).
    ``drawn`` is what an update draws anew in each epoch, a NamedTuple of tensors (n, ...) too.
    """

    observations: PyTorchObs
    actions: th.Tensor
    old_values: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    record: Any
    drawn: Any = ()


class Minibatches:
    """The samples of a rollout once, in some order, a few at a time.

    ``shuffled`` are all of them in this order, or None where they are too large for a copy;
    ``parts`` are the minibatches' places in it.

    :param samples: The rollout's n samples, perhaps with something drawn for each.
    :param order: The order, shape (n,).
    :param size: Samples in a minibatch; the last one may have fewer.
    """

    def __init__(self, samples: FlowRolloutBufferSamples, order: th.Tensor, size: int) -> None:
        self._samples, self._order, self._size = samples, order, size
        self.parts = [slice(start, start + size) for start in range(0, len(order), size)]
        n_bytes = sum(tensor.nbytes for tensor in tensors(samples))
        # Many views of one shuffled copy are faster than many gathers of few small rows.
        is_small = n_bytes <= SHUFFLED_AT_ONCE and are_small(samples)
        self.shuffled = rows(samples, order) if is_small else None

    def __iter__(self) -> Iterator[FlowRolloutBufferSamples]:
        """Go through the minibatches."""
        return map(self.at, self.parts)

    def at(self, part: slice) -> FlowRolloutBufferSamples:
        """The minibatch at one of the ``parts``."""
        if self.shuffled is not None:
            return rows(self.shuffled, part)
        return rows(self._samples, self._order[part])

    def map_advantages(self, function: Callable[[th.Tensor], th.Tensor]) -> None:
        """Replace the advantages of each minibatch.

        :param function: What maps them along the last dimension, for several minibatches at once.
        """
        ordered = self._samples.advantages[self._order]
        n_minibatches = len(ordered) // self._size
        whole = ordered[: n_minibatches * self._size].view(n_minibatches, self._size)
        rest = ordered[n_minibatches * self._size :]
        mapped = [function(values).flatten() for values in (whole, rest) if values.numel() > 0]
        ordered = th.cat(mapped)
        if self.shuffled is not None:
            self.shuffled = self.shuffled._replace(advantages=ordered)
        else:
            advantages = ordered.new_empty(ordered.shape)
            advantages[self._order] = ordered
            self._samples = self._samples._replace(advantages=advantages)


def minibatches_of(buffer: Any, samples: FlowRolloutBufferSamples, size: int) -> Minibatches:
    """The minibatches that a rollout buffer makes of its samples.

    :param buffer: The buffer, whose class may be the user's own.
    :param samples: The samples.
    :param size: Samples in a minibatch.
    :raises TypeError: If the buffer's ``minibatches`` is that of version 0.1.
    """
    found = buffer.minibatches(samples, size)
    if not isinstance(found, Minibatches):
        raise TypeError(
            f"{type(buffer).__name__}.minibatches must return a "
            "sb3_policyflow.common.minibatches.Minibatches, which takes the samples, their "
            f"order and the size, and not a {type(found).__name__}."
        )
    return found
