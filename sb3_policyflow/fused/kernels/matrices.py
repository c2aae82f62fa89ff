"""Matrix products of blocks that fit into the first cache, and simpler loops."""

from typing import Any

import numpy as np

from sb3_policyflow.fused.kernels.options import F, Floats, inner


@inner
def accumulate(inputs: Any, weights: Floats, outputs: Floats) -> None:
    """Outputs += inputs @ weights, eight terms at a time."""
    n_in = weights.shape[0]
    n_whole = n_in - n_in % 8
    for k in range(0, n_whole, 8):
        w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
        w4, w5, w6, w7 = weights[k + 4], weights[k + 5], weights[k + 6], weights[k + 7]
        for row in range(inputs.shape[0]):
            x, y = inputs[row, k : k + 8], outputs[row]
            x0, x1, x2, x3, x4, x5, x6, x7 = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
            for j in range(y.size):
                first = (x0 * w0[j] + x1 * w1[j]) + (x2 * w2[j] + x3 * w3[j])
                second = (x4 * w4[j] + x5 * w5[j]) + (x6 * w6[j] + x7 * w7[j])
                y[j] += first + second
    for k in range(n_whole, n_in):
        w0 = weights[k]
        for row in range(inputs.shape[0]):
            x0, y = inputs[row, k], outputs[row]
            for j in range(y.size):
                y[j] += x0 * w0[j]


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
def product(inputs: Any, weights: Floats) -> Floats:
    """The matrix inputs @ weights."""
    outputs = np.empty((inputs.shape[0], weights.shape[1]), F)
    clear(outputs)
    accumulate(inputs, weights, outputs)
    return outputs


@inner
def transposed(matrix: Any) -> Floats:
    """The transposed matrix, laid out row by row."""
    n_rows, n_columns = matrix.shape
    outputs = np.empty((n_columns, n_rows), F)
    for i in range(n_columns):
        for j in range(n_rows):
            outputs[i, j] = matrix[j, i]
    return outputs


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
    for row in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[row, j] = F(0.0)
