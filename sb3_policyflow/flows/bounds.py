"""What the bounds of actions say about their scale."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

SHORTEST_MEANINGLESS = 200.0
"""Distance of two bounds from which they seem to stand for none. IsaacLab gives -100 and 100 then,
others 1e3, 1e10 or the largest number; in the tasks of Gymnasium they are at most 6 apart."""


def half_ranges(low: ArrayLike, high: ArrayLike) -> NDArray[np.float64]:
    """Half the distance of the bounds of actions; infinity where they are none that mean something.

    >>> half_ranges([-1.0, 0.0, -1e3], [1.0, 1.0, 1e3])
    array([1. , 0.5, inf])

    :param low: Lower bounds, of any shape.
    :param high: Upper bounds, of the same shape.
    :return: Shape (action_dim,); at least 1e-6, also in a dimension that cannot move.
    """
    with np.errstate(over="ignore"):
        widths = np.subtract(high, low, dtype=np.float64).flatten()
    widths[widths >= SHORTEST_MEANINGLESS] = np.inf
    return np.maximum(widths / 2, 1e-6)
