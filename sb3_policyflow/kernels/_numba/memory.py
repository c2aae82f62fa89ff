"""Parameters and gradients where they are in memory."""

import math
from typing import Any

import numpy as np
from numba import carray, types
from numba.extending import intrinsic

from sb3_policyflow.kernels._numba.options import F, inner, kernel
from sb3_policyflow.kernels.layouts import Floats, Integers


def _pointer_to(number: Any) -> Any:
    """Make the function that takes an address for a pointer to numbers of a type."""

    def pointer(_context: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(number)(address), codegen

    return intrinsic(pointer)


FLOAT32_MAX = float(np.finfo(np.float32).max)

_floats = _pointer_to(types.float32)
_bits = _pointer_to(types.int32)


@inner
def vector(address: int, size: int) -> Floats:
    """The numbers at an address."""
    return carray(_floats(address), (size,))


@inner
def matrix(address: int, n_rows: int, n_columns: int) -> Floats:
    """The matrix at an address."""
    return carray(_floats(address), (n_rows, n_columns))


@kernel
def are_same(addresses: Integers, others: Integers, sizes: Integers) -> bool:
    """Whether the numbers at some addresses have the bits of those at others."""
    for place in range(addresses.size):
        numbers = carray(_bits(addresses[place]), (sizes[place],))
        other_numbers = carray(_bits(others[place]), (sizes[place],))
        difference = np.int32(0)
        for i in range(numbers.size):
            difference |= numbers[i] ^ other_numbers[i]
        if difference != 0:
            return False
    return True


@kernel
def clip(addresses: Integers, sizes: Integers, max_norm: float) -> float:
    """Scale the numbers at some addresses to a Euclidean norm, if theirs is finite and greater.

    :param addresses: Where arrays start.
    :param sizes: How many numbers each has.
    :param max_norm: The norm; infinity to leave them alone.
    :return: The norm that they had; as torch's, infinite if its square is so in float32.
    """
    total = 0.0
    for place in range(addresses.size):
        numbers = vector(addresses[place], sizes[place])
        squares = 0.0
        for i in range(numbers.size):
            squares += np.float64(numbers[i]) * np.float64(numbers[i])
        total += squares
    norm = math.sqrt(total) if total <= FLOAT32_MAX else np.inf
    factor = F(max_norm / (norm + 1e-6))
    if factor < F(1.0) and norm < np.inf:
        for place in range(addresses.size):
            numbers = vector(addresses[place], sizes[place])
            for i in range(numbers.size):
                numbers[i] *= factor
    return norm
