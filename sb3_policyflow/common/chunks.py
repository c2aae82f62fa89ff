"""Evaluating whole rollouts without holding all intermediate results at once."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch as th

from sb3_policyflow.common.type_aliases import rows

T = TypeVar("T")
CHUNK = 8192
"""Rows evaluated at a time: large enough to be fast, small enough for images."""


def in_chunks(function: Callable[[T], th.Tensor], tree: T) -> th.Tensor:
    """Apply a function to the rows of nested tensors, some at a time, without gradients.

    >>> in_chunks(lambda pair: pair[0] + pair[1], (th.ones(3), th.arange(3)))
    tensor([1., 2., 3.])

    :param function: Maps k rows of ``tree`` to a tensor (k, ...).
    :param tree: Tensors (n, ...) in dictionaries and tuples.
    :return: The results in order, shape (n, ...).
    """
    with th.no_grad():
        starts = range(0, _n_rows(tree), CHUNK)
        return th.cat([function(rows(tree, slice(start, start + CHUNK))) for start in starts])


def _n_rows(tree: Any) -> int:
    """Length of the first tensor."""
    while not isinstance(tree, th.Tensor):
        tree = next(iter(tree.values() if isinstance(tree, dict) else tree))
    return len(tree)
