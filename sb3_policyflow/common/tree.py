"""Nested dictionaries and tuples of tensors, such as a minibatch with its record."""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import torch as th

T = TypeVar("T")
CHUNK = 8192
"""Small rows that are evaluated at a time; on a GPU as many as in training, if these are more."""
SMALL_ROW = 1024
"""Numbers in a row up to which it is small. An image has more, and a features extractor makes
several times as many of them: of images, no more are evaluated at a time than training does."""


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


def rows(tree: T, chosen: th.Tensor | slice) -> T:
    """Some of the rows of every tensor in nested dictionaries and tuples."""
    return map_tensors(lambda values: values[chosen], tree)


def tensors(tree: Any) -> Iterator[th.Tensor]:
    """Every tensor in nested dictionaries and tuples.

    >>> sum(tensor.nbytes for tensor in tensors({"a": th.zeros(3), "b": (th.zeros(2),)}))
    20
    """
    if isinstance(tree, th.Tensor):
        yield tree
    else:
        for part in tree.values() if isinstance(tree, dict) else tree:
            yield from tensors(part)


def are_small(tree: Any) -> bool:
    """Whether the rows of nested tensors are small: see :data:`SMALL_ROW`.

    >>> are_small({"a": th.zeros(5, 3)}), are_small((th.zeros(5), th.zeros(5, 3, 84, 84)))
    (True, False)
    """
    return sum(tensor[:1].numel() for tensor in tensors(tree)) <= SMALL_ROW


def in_chunks(function: Callable[[T], th.Tensor], tree: T, batch_size: int) -> th.Tensor:
    """Apply a function to the rows of nested tensors, some at a time, without gradients.

    >>> in_chunks(lambda pair: pair[0] + pair[1], (th.ones(3), th.arange(3)), batch_size=2)
    tensor([1., 2., 3.])

    :param function: Maps k rows of ``tree`` to a tensor (k, ...).
    :param tree: Tensors (n, ...) in dictionaries and tuples.
    :param batch_size: How many large rows may be evaluated at a time, at most, as in training.
    :return: The results in order, shape (n, ...).
    """
    first_tensor = next(tensors(tree))
    n_rows = len(first_tensor)
    size = CHUNK if are_small(tree) else min(batch_size, CHUNK)
    if first_tensor.is_cuda:
        size = max(size, batch_size)
    with th.no_grad():
        first = function(rows(tree, slice(0, size)))
        if size >= n_rows:
            return first
        # One tensor: many small ones would lie between what a chunk takes and gives back, and keep
        # its memory from being used again.
        results = first.new_empty(n_rows, *first.shape[1:])
        results[:size] = first
        for start in range(size, n_rows, size):
            part = slice(start, start + size)
            results[part] = function(rows(tree, part))
        return results
