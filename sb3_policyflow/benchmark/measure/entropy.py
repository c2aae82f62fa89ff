"""How evenly something is spread."""

import numpy as np
from numpy.typing import ArrayLike


def normalized_entropy(counts: ArrayLike) -> float:
    r"""Entropy of the shares over its greatest value, ``-sum p log p / log n``; 0 if all are 0.

    >>> round(normalized_entropy([70, 72, 280, 136, 127, 87]), 2)
    0.92

    :param counts: Non-negative numbers, at least two, shape (n,).
    :raises ValueError: If they are not.
    """
    array = np.asarray(counts, dtype=np.float64)
    if array.ndim != 1 or len(array) < 2 or not (array >= 0).all():
        raise ValueError(f"Entropy needs two or more counts, none negative, not {counts!r}.")
    shares = array[array > 0] / array.sum() if array.any() else np.ones(1)
    return float(abs(np.sum(shares * np.log(shares))) / np.log(len(array)))
