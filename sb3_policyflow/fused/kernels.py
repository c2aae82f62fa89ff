"""Kernels that numba compiles when they are first called, and keeps for later processes.

They take arrays of float32, and work on few enough rows at a time to stay in the caches. Import
this module through :func:`sb3_policyflow.fused.compiler.kernels`.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]
Bits = NDArray[np.int32]

F = np.float32
ROWS = 16
"""Rows that are carried through a network together."""

# Divisions by zero give infinity, as in torch, and threads may run beside each other. Exact: what
# follows is evaluated as written, up to fused multiply-adds. Sums: in any order, as in a BLAS.
EXACT = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
SUMS = {**EXACT, "fastmath": {"contract", "reassoc", "nsz"}}

RELU, LEAKY_RELU, ELU, TANH, SIGMOID, SILU, MISH = range(7)


# Activations: loops over vectorised formulas of a few rounding errors


@njit(**EXACT)
def _exp_parts(x: Any) -> Any:
    """(m, s) with e^x = s (1 + m), where s is a power of two and |m| < 0.42; NaN stays NaN."""
    x = F(88.0) if x > F(88.0) else x
    x = F(-87.0) if x < F(-87.0) else x
    n = np.floor(x * F(1.44269504) + F(0.5))
    r = (x - n * F(0.693359375)) - n * F(-2.12194440e-4)
    p = F(1.9875691500e-4)
    p = p * r + F(1.3981999507e-3)
    p = p * r + F(8.3334519073e-3)
    p = p * r + F(4.1665795894e-2)
    p = p * r + F(1.6666665459e-1)
    p = p * r + F(5.0000001201e-1)
    scale = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return p * (r * r) + r, scale


@njit(**EXACT)
def _exp(x: Any) -> Any:
    m, s = _exp_parts(x)
    return m * s + s


@njit(**EXACT)
def _tanh(x: Any) -> Any:
    """By a polynomial near zero and 1 - 2 / (e^2|x| + 1) elsewhere."""
    square = x * x
    p = F(-5.70498872745e-3)
    p = p * square + F(2.06390887954e-2)
    p = p * square + F(-5.37397155531e-2)
    p = p * square + F(1.33314422036e-1)
    p = p * square + F(-3.33332819422e-1)
    near = p * square * x + x
    size = abs(x)
    far = F(1.0) - F(2.0) / (_exp(F(2.0) * size) + F(1.0))
    far = -far if x < F(0.0) else far
    return far if size > F(0.625) else near


@njit(**EXACT)
def activate(kind: int, alpha: Any, values: Floats) -> None:
    """Apply an activation in place.

    mish(x) = x w / (w + 2) with w = u (u + 2) and u = e^x, which needs one exponential.
    """
    flat = values.reshape(-1)
    n = flat.size
    if kind == MISH:
        for i in range(n):
            x = flat[i]
            u = _exp(F(20.0) if x > F(20.0) else x)
            w = u * (u + F(2.0))
            flat[i] = x * (w / (w + F(2.0)))
    elif kind == TANH:
        for i in range(n):
            flat[i] = _tanh(flat[i])
    elif kind == RELU:
        for i in range(n):
            flat[i] = F(0.0) if flat[i] < F(0.0) else flat[i]
    elif kind == SILU:
        for i in range(n):
            flat[i] = flat[i] / (F(1.0) + _exp(-flat[i]))
    elif kind == ELU:
        for i in range(n):
            x = flat[i]
            m, s = _exp_parts(x)
            flat[i] = x if x > F(0.0) else alpha * (m * s + (s - F(1.0)))
    elif kind == LEAKY_RELU:
        for i in range(n):
            flat[i] = alpha * flat[i] if flat[i] < F(0.0) else flat[i]
    else:
        for i in range(n):
            flat[i] = F(1.0) / (F(1.0) + _exp(-flat[i]))


# Matrix products of blocks


@njit(**SUMS)
def accumulate(inputs: Floats, weights: Floats, outputs: Floats) -> None:
    """outputs += inputs @ weights, eight terms at a time."""
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


@njit(**SUMS)
def project(inputs: Floats, weights: Floats, bias: Floats, outputs: Floats) -> None:
    """outputs = inputs @ weights.T + bias, for few outputs."""
    for row in range(inputs.shape[0]):
        x = inputs[row]
        for j in range(bias.size):
            w, total = weights[j], F(0.0)
            for k in range(x.size):
                total += x[k] * w[k]
            outputs[row, j] = total + bias[j]


# Parameters in memory


@intrinsic  # type: ignore[untyped-decorator]
def _pointer(_context: Any, address: Any) -> Any:
    """The address as a pointer to the bits of float32 numbers."""
    pointer = types.CPointer(types.int32)

    def codegen(_target: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], ir.IntType(32).as_pointer())

    return pointer(address), codegen


@njit(**EXACT)
def renew(addresses: Integers, sizes: Integers, copy: Bits) -> bool:
    """Copy arrays at these addresses one behind the other; say whether a bit of the copy changed."""
    changed = False
    start = 0
    for index in range(addresses.size):
        pointer = _pointer(addresses[index])
        size = sizes[index]
        target = copy[start : start + size]
        difference = np.int32(0)
        for i in range(size):
            difference |= pointer[i] ^ target[i]
        if difference != 0:
            changed = True
            for i in range(size):
                target[i] = pointer[i]
        start += size
    return changed


# Networks


@njit(**SUMS)
def hidden_layers(
    weights: Floats, widths: Integers, kind: int, alpha: Any, values: Floats, spare: Floats
) -> Any:
    """Carry a block from before the first activation to behind the last.

    :param weights: For each layer but the first its weights (n_in, n_out) and biases, flat.
    :param widths: Outputs of each layer.
    :param kind: The activation.
    :param alpha: Its parameter.
    :param values: What the first layer yields, shape (rows, widths[0]); overwritten.
    :param spare: Room for two blocks of any layer.
    :return: The last layer's activations, shape (rows, widths[-1]), and where ``weights`` ended.
    """
    rows = values.shape[0]
    start, side = 0, 0
    activate(kind, alpha, values)
    for layer in range(1, widths.size):
        n_in, n_out = widths[layer - 1], widths[layer]
        matrix = weights[start : start + n_in * n_out].reshape((n_in, n_out))
        start += n_in * n_out
        bias = weights[start : start + n_out]
        start += n_out
        outputs = spare[side, : rows * n_out].reshape((rows, n_out))
        for row in range(rows):
            outputs[row, :] = bias
        accumulate(values, matrix, outputs)
        activate(kind, alpha, outputs)
        values, side = outputs, 1 - side
    return values, start


@njit(**SUMS)
def flow(
    weights: Floats,
    widths: Integers,
    kind: int,
    alpha: float,
    table: Floats,
    stages: Integers,
    tableau: Floats,
    features: Floats,
    latents: Floats,
    endpoints: Floats,
    start: int,
    stop: int,
) -> None:
    """Carry latents to their end points with a fixed-step solver.

    Stage i of a step looks at y_i = x + sum_j a_ij k_j and ends it with x += sum_i b_i k_i, where
    a and b contain the step size; a method with memory adds m (k_0 - k_0 of the step before).

    :param weights: Flat: those of the points (dim, widths[0]), of the features
        (n_features, widths[0]), of the hidden layers, of the output (dim, widths[-1]), its bias.
    :param widths: Outputs of each hidden layer.
    :param kind: The activation.
    :param alpha: Its parameter.
    :param table: What time adds to the first layer, a row for each time.
    :param stages: Row of the table for each step and stage.
    :param tableau: Rows a_i, then b, then m.
    :param features: shape (n, n_features).
    :param latents: shape (n, dim).
    :param endpoints: Filled; shape (n, dim).
    :param start: First row to carry.
    :param stop: Row behind the last.
    """
    alpha = F(alpha)
    dim, n_features, width = latents.shape[1], features.shape[1], widths[0]
    end_points = dim * width
    end_features = end_points + n_features * width
    point_weights = weights[:end_points].reshape((dim, width))
    feature_weights = weights[end_points:end_features].reshape((n_features, width))
    n_stages = stages.shape[1]
    memory = tableau[n_stages + 1, 0]
    shifts = np.empty((ROWS, width), F)
    firsts = np.empty((ROWS, width), F)
    spare = np.empty((2, ROWS * widths.max()), F)
    slopes = np.empty((n_stages, ROWS, dim), F)
    inputs = np.empty((ROWS, dim), F)
    previous = np.empty((ROWS, dim), F)
    for first in range(start, stop, ROWS):
        rows = min(ROWS, stop - first)
        shift, block, looked = shifts[:rows], firsts[:rows], inputs[:rows]
        x = endpoints[first : first + rows]
        x[:, :] = latents[first : first + rows]
        shift[:, :] = F(0.0)
        accumulate(features[first : first + rows], feature_weights, shift)
        for step in range(stages.shape[0]):
            for stage in range(n_stages):
                _combine(x, slopes, tableau[stage], stage, looked)
                time_shift = table[stages[step, stage]]
                for row in range(rows):
                    for j in range(width):
                        block[row, j] = shift[row, j] + time_shift[j]
                accumulate(looked, point_weights, block)
                values, used = hidden_layers(
                    weights[end_features:], widths, kind, alpha, block, spare
                )
                end = weights[end_features + used :]
                n_last = widths[-1]
                project(
                    values,
                    end[: dim * n_last].reshape((dim, n_last)),
                    end[dim * n_last : dim * n_last + dim],
                    slopes[stage, :rows],
                )
            _combine(x, slopes, tableau[n_stages], n_stages, x)
            if memory != 0.0:
                for row in range(rows):
                    for i in range(dim):
                        slope = slopes[0, row, i]
                        if step > 0:
                            x[row, i] += memory * (slope - previous[row, i])
                        previous[row, i] = slope


@njit(**SUMS)
def _combine(
    points: Floats, slopes: Floats, weights: Floats, n_slopes: int, outputs: Floats
) -> None:
    """outputs = points + the weighted sum of the first slopes."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            total = points[row, i]
            for j in range(n_slopes):
                total += weights[j] * slopes[j, row, i]
            outputs[row, i] = total
