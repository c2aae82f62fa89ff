"""Products of matrices that fit into the caches, and simpler loops."""

from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.options import F, inner
from sb3_policyflow.kernels._numba.tiles import (
    LONG,
    TALL,
    WIDE,
    half,
    long,
    slim,
    tall_half,
    tall_slim,
    tall_wide,
)
from sb3_policyflow.kernels._numba.views import block, span, strided, turned
from sb3_policyflow.kernels.layouts import Floats


@inner
def accumulate(inputs: Any, weights: Floats, outputs: Floats) -> None:
    """Outputs += inputs @ weights, of which weights and outputs are contiguous."""
    _accumulate(strided(inputs), weights, outputs)


@inner
def accumulate_turned(inputs: Any, weights: Floats, outputs: Floats) -> None:
    """Outputs += inputs.T @ weights, likewise."""
    _accumulate(turned(inputs), weights, outputs)


@inner
def _accumulate(inputs: Any, weights: Floats, outputs: Floats) -> None:
    n_rows, n_columns = outputs.shape
    n_tall = n_rows - n_rows % TALL
    for row in range(0, n_tall, TALL):
        _accumulate_tall(inputs, weights, outputs, row)
    for row in range(n_tall, n_rows):
        _accumulate_row(inputs, weights, outputs, row)
    for row in range(n_rows):
        for k in range(weights.shape[0]):
            for j in range(n_columns - n_columns % 4, n_columns):
                outputs[row, j] += inputs[row, k] * weights[k, j]


@inner
def _accumulate_tall(inputs: Any, weights: Floats, outputs: Floats, row: int) -> None:
    """Do the rows of a tall tile, but for up to three last columns."""
    n_columns, column = outputs.shape[1], 0
    while column + WIDE <= n_columns:
        tall_wide(inputs, weights, outputs, row, column)
        column += WIDE
    while column + WIDE // 2 <= n_columns:
        tall_half(inputs, weights, outputs, row, column)
        column += WIDE // 2
    while column + 4 <= n_columns:
        tall_slim(inputs, weights, outputs, row, column)
        column += 4


@inner
def _accumulate_row(inputs: Any, weights: Floats, outputs: Floats, row: int) -> None:
    """Do one row, but for up to three last columns."""
    n_columns, column = outputs.shape[1], 0
    while column + LONG <= n_columns:
        long(inputs, weights, outputs, row, column)
        column += LONG
    while column + WIDE // 2 <= n_columns:
        half(inputs, weights, outputs, row, column)
        column += WIDE // 2
    while column + 4 <= n_columns:
        slim(inputs, weights, outputs, row, column)
        column += 4


@inner
def project(inputs: Floats, weights: Floats, bias: Floats, outputs: Floats) -> None:
    """Outputs = inputs @ weights.T + bias, for few outputs."""
    for row in range(inputs.shape[0]):
        x = inputs[row]
        for j in range(bias.size):
            w, total = weights[j], F(0.0)
            for k in range(x.size):
                total += x[k] * w[k]
            outputs[row, j] = total + bias[j]


@inner
def floats(size: int) -> Floats:
    """Space for so many numbers."""
    return np.empty(size, F)


@inner
def zeros(n_rows: int, n_columns: int) -> Floats:
    """A matrix of zeros."""
    outputs = block(floats(n_rows * n_columns), 0, n_rows, n_columns)
    clear(outputs)
    return outputs


@inner
def product(inputs: Floats, weights: Floats) -> Floats:
    """The matrix inputs @ weights."""
    outputs = zeros(inputs.shape[0], weights.shape[1])
    accumulate(inputs, weights, outputs)
    return outputs


@inner
def transposed(matrix: Floats) -> Floats:
    """The transposed matrix, laid out row by row."""
    n_rows, n_columns = matrix.shape
    outputs = block(floats(matrix.size), 0, n_columns, n_rows)
    transpose(matrix, outputs)
    return outputs


@inner
def transpose(matrix: Floats, outputs: Floats) -> None:
    """Outputs = matrix.T."""
    n_rows, n_columns = matrix.shape
    # Strips of 16 rows: as many lines of the cache, each used 16 times, make one of the outputs.
    for start in range(0, n_rows, 16):
        stop = min(start + 16, n_rows)
        for i in range(n_columns):
            for j in range(start, stop):
                outputs[i, j] = matrix[j, i]


@inner
def copy(source: Any, target: Any) -> None:
    """Copy numbers, as many as the source has."""
    for i in range(source.size):
        target[i] = source[i]


@inner
def add(source: Any, target: Any) -> None:
    """Add numbers, as many as the source has."""
    for i in range(source.size):
        target[i] += source[i]


@inner
def multiply(target: Any, factors: Any) -> None:
    """Multiply numbers, as many as the factors are."""
    for i in range(factors.size):
        target[i] *= factors[i]


@inner
def clear(target: Any) -> None:
    """Fill a matrix with zeros."""
    numbers = span(target, 0, target.size)
    for i in range(numbers.size):
        numbers[i] = F(0.0)
