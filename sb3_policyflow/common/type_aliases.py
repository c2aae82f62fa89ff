"""Types shared by the algorithms."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

T = TypeVar("T")


class FlowRolloutBufferSamples(NamedTuple):
    """Transitions with the record of how each action was made; n samples along the first axis.

    ``record`` is what the policy's ``forward`` returned, a NamedTuple of tensors (n, ...).
    ``probes`` is what an algorithm draws anew in each epoch, a NamedTuple of tensors (n, ...) too.
    """

    observations: PyTorchObs
    actions: th.Tensor
    old_values: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    record: Any
    probes: Any = ()


class PolicyTerms(NamedTuple):
    """What an algorithm's policy loss is made of, for one minibatch of n samples.

    ``log_ratio`` has shape (n, ...), with one entry for each surrogate; ``kl`` has no dimensions
    and measures the change of the policy in nats; ``regularizer`` is added to the loss;
    ``metrics`` are logged under ``train/``.
    """

    log_ratio: th.Tensor
    kl: th.Tensor
    regularizer: th.Tensor
    metrics: dict[str, th.Tensor]


def rows(tree: T, chosen: th.Tensor | slice) -> T:
    """Some of the rows of every tensor in nested dictionaries and tuples."""
    return map_tensors(lambda values: values[chosen], tree)


def size_in_bytes(tree: Any) -> int:
    """Size of all tensors in nested dictionaries and tuples.

    >>> size_in_bytes({"a": th.zeros(3), "b": (th.zeros(2, dtype=th.int64),)})
    28
    """
    sizes: list[int] = []

    def note(values: th.Tensor) -> th.Tensor:
        sizes.append(values.nbytes)
        return values

    map_tensors(note, tree)
    return sum(sizes)


def map_tensors(function: Callable[[th.Tensor], th.Tensor], tree: T) -> T:
    """Apply a function to every tensor in nested dictionaries and tuples.

    >>> map_tensors(lambda x: x + 1, {"a": th.tensor(1), "b": ()})
    {'a': tensor(2), 'b': ()}
    """
    mapped: Any
    if isinstance(tree, th.Tensor):
        mapped = function(tree)
    elif isinstance(tree, dict):
        mapped = {key: map_tensors(function, value) for key, value in tree.items()}
    elif isinstance(tree, tuple):
        parts = [map_tensors(function, value) for value in tree]
        mapped = type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    else:
        raise TypeError(f"Expected tensors in dictionaries or tuples, got {type(tree).__name__}.")
    result: T = mapped
    return result
