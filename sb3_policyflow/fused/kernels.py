"""Kernels that numba compiles when they are first called, and keeps for later processes.

They take arrays of float32, and work on few enough rows at a time to stay in the caches. Import
this module through :func:`sb3_policyflow.fused.compiler.kernels`.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, njit, types
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
# Functions that only kernels call need no way in from Python, which takes time to compile.
INNER = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
EXACT_INNER, SUMS_INNER = {**EXACT, **INNER}, {**SUMS, **INNER}

RELU, LEAKY_RELU, ELU, TANH, SIGMOID, SILU, MISH = range(7)


# Activations: loops over vectorised formulas of a few rounding errors


@njit(**EXACT_INNER)
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


@njit(**EXACT_INNER)
def _exp(x: Any) -> Any:
    m, s = _exp_parts(x)
    return m * s + s


@njit(**EXACT_INNER)
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


@njit(**EXACT_INNER)
def _mish_parts(x: Any) -> Any:
    """(u, w, 1 / (w + 2)) with u = e^x and w = u (u + 2): mish(x) = x w / (w + 2)."""
    u = _exp(F(20.0) if x > F(20.0) else x)
    w = u * (u + F(2.0))
    return u, w, F(1.0) / (w + F(2.0))


@njit(**EXACT_INNER)
def _elu(x: Any, alpha: Any) -> Any:
    m, s = _exp_parts(x)
    return x if x > F(0.0) else alpha * (m * s + (s - F(1.0)))


@njit(**EXACT_INNER)
def activate(kind: int, alpha: Any, values: Floats) -> None:
    """Apply an activation in place."""
    if kind == MISH:
        for i in range(values.size):
            _, w, inverse = _mish_parts(values[i])
            values[i] *= w * inverse
    elif kind == TANH:
        for i in range(values.size):
            values[i] = _tanh(values[i])
    elif kind == RELU:
        for i in range(values.size):
            values[i] = F(0.0) if values[i] < F(0.0) else values[i]
    elif kind == LEAKY_RELU:
        for i in range(values.size):
            values[i] = alpha * values[i] if values[i] < F(0.0) else values[i]
    elif kind == SILU:
        for i in range(values.size):
            values[i] /= F(1.0) + _exp(-values[i])
    elif kind == ELU:
        for i in range(values.size):
            values[i] = _elu(values[i], alpha)
    else:
        for i in range(values.size):
            values[i] = F(1.0) / (F(1.0) + _exp(-values[i]))


@njit(**EXACT_INNER)
def activate_with_slopes(kind: int, alpha: Any, values: Floats, slopes: Floats) -> None:
    """Apply an activation in place, and keep its derivatives.

    mish'(x) = w / (w + 2) + 4 x u (u + 1) / (w + 2)^2
    """
    if kind == MISH:
        for i in range(values.size):
            u, w, inverse = _mish_parts(values[i])
            gate = w * inverse
            slopes[i] = gate + F(4.0) * values[i] * (u * (u + F(1.0)) * inverse) * inverse
            values[i] *= gate
    elif kind == TANH:
        for i in range(values.size):
            y = _tanh(values[i])
            values[i] = y
            slopes[i] = F(1.0) - y * y
    elif kind == RELU:
        for i in range(values.size):
            slopes[i] = F(0.0) if values[i] <= F(0.0) else F(1.0)
            values[i] = F(0.0) if values[i] < F(0.0) else values[i]
    elif kind == LEAKY_RELU:
        for i in range(values.size):
            slopes[i] = F(1.0) if values[i] > F(0.0) else alpha
            values[i] = alpha * values[i] if values[i] < F(0.0) else values[i]
    elif kind == SILU:
        for i in range(values.size):
            gate = F(1.0) / (F(1.0) + _exp(-values[i]))
            slopes[i] = gate * (F(1.0) + values[i] * (F(1.0) - gate))
            values[i] *= gate
    elif kind == ELU:
        for i in range(values.size):
            y = _elu(values[i], alpha)
            slopes[i] = F(1.0) if values[i] > F(0.0) else y + alpha
            values[i] = y
    else:
        for i in range(values.size):
            y = F(1.0) / (F(1.0) + _exp(-values[i]))
            values[i] = y
            slopes[i] = y * (F(1.0) - y)


# Matrix products of blocks


@njit(**SUMS_INNER)
def accumulate(inputs: Floats, weights: Floats, outputs: Floats) -> None:
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


@njit(**EXACT_INNER)
def _copy(source: Any, target: Any) -> None:
    for i in range(source.size):
        target[i] = source[i]


@njit(**SUMS_INNER)
def _add(source: Any, target: Any) -> None:
    for i in range(source.size):
        target[i] += source[i]


@njit(**EXACT_INNER)
def _clear(target: Any) -> None:
    for row in range(target.shape[0]):
        for i in range(target.shape[1]):
            target[row, i] = F(0.0)


@njit(**SUMS_INNER)
def project(inputs: Floats, weights: Floats, bias: Floats, outputs: Floats) -> None:
    """Outputs = inputs @ weights.T + bias, for few outputs."""
    for row in range(inputs.shape[0]):
        x = inputs[row]
        for j in range(bias.size):
            w, total = weights[j], F(0.0)
            for k in range(x.size):
                total += x[k] * w[k]
            outputs[row, j] = total + bias[j]


# Parameters in memory


def _pointer_to(number: Any) -> Any:
    """Make the function that takes an address for a pointer to numbers of a type."""

    def pointer(_context: Any, address: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(number)(address), codegen

    return intrinsic(pointer)


_floats = _pointer_to(types.float32)
_bits = _pointer_to(types.int32)


@njit(**EXACT)
def renew(addresses: Integers, sizes: Integers, copy: Bits) -> bool:
    """Copy the numbers at some addresses one behind the other; say whether a bit has changed."""
    changed = False
    start = 0
    for index in range(addresses.size):
        numbers = carray(_bits(addresses[index]), (sizes[index],))
        target = copy[start : start + numbers.size]
        start += numbers.size
        difference = np.int32(0)
        for i in range(numbers.size):
            difference |= numbers[i] ^ target[i]
        if difference != 0:
            changed = True
            _copy(numbers, target)
    return changed


@njit(**EXACT_INNER)
def _arrange(addresses: Integers, widths: Integers) -> Floats:
    """Weights and biases at their addresses, as :func:`hidden_layers` takes them."""
    size = 0
    for layer in range(1, widths.size):
        size += (widths[layer - 1] + 1) * widths[layer]
    weights = np.empty(size, F)
    end = 0
    for layer in range(1, widths.size):
        n_in, n_out = widths[layer - 1], widths[layer]
        matrix = carray(_floats(addresses[2 * layer - 2]), (n_out, n_in))
        target = weights[end : end + n_in * n_out].reshape((n_in, n_out))
        for i in range(n_in):
            for j in range(n_out):
                target[i, j] = matrix[j, i]
        end += n_in * n_out
        bias = carray(_floats(addresses[2 * layer - 1]), (n_out,))
        _copy(bias, weights[end : end + n_out])
        end += n_out
    return weights


# Networks


@njit(**SUMS_INNER)
def hidden_layers(
    weights: Floats, widths: Integers, kind: int, alpha: Any, values: Floats, slopes: Floats
) -> Any:
    """Carry a block of rows from the first layer to the last activation.

    :param weights: For each layer behind the first its weights (n_in, n_out) and biases, flat.
    :param widths: Outputs of each layer.
    :param kind: The activation.
    :param alpha: Its parameter.
    :param values: Room for the activations of all layers, flat; holds what the first layer yields.
    :param slopes: Room for their derivatives; of size 0 if they are not wanted.
    :return: The last layer's activations, shape (rows, widths[-1]).
    """
    rows = values.size // widths.sum()
    start, end, used = 0, rows * widths[0], 0
    inputs = values[start:end].reshape((rows, widths[0]))
    for layer in range(widths.size):
        n_out = widths[layer]
        outputs = values[start:end].reshape((rows, n_out))
        if layer > 0:
            n_in = widths[layer - 1]
            matrix = weights[used : used + n_in * n_out].reshape((n_in, n_out))
            used += n_in * n_out
            for row in range(rows):
                _copy(weights[used : used + n_out], outputs[row])
            used += n_out
            accumulate(inputs, matrix, outputs)
        if slopes.size > 0:
            activate_with_slopes(kind, alpha, values[start:end], slopes[start:end])
        else:
            activate(kind, alpha, values[start:end])
        inputs = outputs
        if layer + 1 < widths.size:
            start, end = end, end + rows * widths[layer + 1]
    return inputs


class Network(NamedTuple):
    """A velocity field as the sampler takes it.

    Weights of the first layer for points (dim, widths[0]) and features (n_features, widths[0]);
    those of the hidden layers and their widths, see :func:`hidden_layers`; weights (dim,
    widths[-1]) and biases of the output; the activation and its parameter.
    """

    points: Floats
    features: Floats
    hidden: Floats
    widths: Integers
    output: Floats
    bias: Floats
    kind: int
    alpha: Any


class Method(NamedTuple):
    """A fixed-step solver.

    Stage i of a step looks at y_i = x + sum_j a_ij k_j, and a step ends at x + sum_i b_i k_i, where
    a and b contain the step size; a method with memory adds m (k_0 - k_0 of the step before).

    What each time adds to the first layer (n_times, widths[0]); the row of this table for each step
    and stage; and the rows a_i, b, m.
    """

    table: Floats
    stages: Integers
    tableau: Floats


@njit(**SUMS)
def flow(
    network: Network,
    method: Method,
    features: Floats,
    latents: Floats,
    endpoints: Floats,
    start: int,
    stop: int,
) -> None:
    """Carry rows of latents to their end points, given the features of each."""
    width, dim = network.widths[0], latents.shape[1]
    values = np.empty(ROWS * network.widths.sum(), F)
    shifts = np.empty((ROWS, width), F)
    slopes = np.empty((method.stages.shape[1], ROWS, dim), F)
    spare = np.empty((2, ROWS, dim), F)
    for first in range(start, stop, ROWS):
        last = min(first + ROWS, stop)
        rows = last - first
        shift = shifts[:rows]
        _clear(shift)
        accumulate(features[first:last], network.features, shift)
        for row in range(first, last):
            _copy(latents[row], endpoints[row])
        _integrate(
            network,
            method,
            shift,
            endpoints[first:last],
            values[: rows * network.widths.sum()],
            slopes[:, :rows],
            spare[:, :rows],
        )


@njit(**SUMS_INNER)
def _integrate(
    network: Network,
    method: Method,
    shift: Floats,
    points: Floats,
    values: Floats,
    slopes: Floats,
    spare: Floats,
) -> None:
    """Carry a block of points, in place."""
    n_steps, n_stages = method.stages.shape
    looked, previous = spare[0], spare[1]
    memory = method.tableau[n_stages + 1, 0]
    for step in range(n_steps):
        for stage in range(n_stages):
            _combine(points, slopes[:stage], method.tableau[stage], looked)
            time_shift = method.table[method.stages[step, stage]]
            _velocity(network, looked, shift, time_shift, values, slopes[stage])
        _combine(points, slopes, method.tableau[n_stages], points)
        if memory != F(0.0):
            _remember(points, slopes[0], previous, memory if step > 0 else F(0.0))


@njit(**SUMS_INNER)
def _remember(points: Floats, slopes: Floats, previous: Floats, memory: Any) -> None:
    """Points += memory * (slopes - previous), and the slopes are the next previous ones."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            if memory != F(0.0):
                points[row, i] += memory * (slopes[row, i] - previous[row, i])
            previous[row, i] = slopes[row, i]


@njit(**SUMS_INNER)
def _velocity(
    network: Network,
    points: Floats,
    shift: Floats,
    time_shift: Floats,
    values: Floats,
    velocity: Floats,
) -> None:
    rows, width = shift.shape
    first = values[: rows * width].reshape((rows, width))
    for row in range(rows):
        for j in range(width):
            first[row, j] = shift[row, j] + time_shift[j]
    accumulate(points, network.points, first)
    hidden = hidden_layers(
        network.hidden, network.widths, network.kind, network.alpha, values, values[:0]
    )
    project(hidden, network.output, network.bias, velocity)


@njit(**SUMS_INNER)
def _combine(points: Floats, slopes: Floats, weights: Floats, outputs: Floats) -> None:
    """Outputs = points + the weighted sum of the slopes."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            total = points[row, i]
            for j in range(slopes.shape[0]):
                total += weights[j] * slopes[j, row, i]
            outputs[row, i] = total


# Networks that learn


@njit(**SUMS)
def forward(
    inputs: Floats,
    first: Floats,
    table: Floats,
    index: Integers,
    shifts: Floats,
    addresses: Integers,
    widths: Integers,
    output: Floats,
    bias: Floats,
    kind: int,
    alpha: float,
    outputs: Floats,
    values: Floats,
    slopes: Floats,
    start: int,
    stop: int,
) -> None:
    """Evaluate a network on some rows.

    The first layer is inputs @ first + table[index] + shifts, of which each row serves as many
    rows of inputs as there are to each.

    :param inputs: shape (n, n_inputs).
    :param first: shape (n_inputs, widths[0]).
    :param table: shape (n_entries, widths[0]).
    :param index: Entry of the table for each row, shape (n,).
    :param shifts: shape (m, widths[0]) where m divides n, or m = 0.
    :param addresses: Of weight (n_out, n_in) and bias of each layer between first and output.
    :param widths: Outputs of each layer but the output.
    :param output: shape (n_outputs, widths[-1]).
    :param bias: shape (n_outputs,).
    :param kind: The activation.
    :param alpha: Its parameter.
    :param outputs: Filled; shape (n, n_outputs).
    :param values: Filled with what :func:`backward` needs, n * sum(widths); or empty.
    :param slopes: Likewise.
    :param start: The first row.
    :param stop: The row behind the last.
    """
    alpha = F(alpha)
    width, total = widths[0], widths.sum()
    hidden = _arrange(addresses, widths)
    room = np.empty(ROWS * total, F)
    group = inputs.shape[0] // max(shifts.shape[0], 1)
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        rows = end - begin
        block, tilt = room[: rows * total], slopes[begin * total : end * total]
        if slopes.size > 0:
            block = values[begin * total : end * total]
        layer = block[: rows * width].reshape((rows, width))
        for row in range(rows):
            _copy(table[index[begin + row]], layer[row])
            if shifts.shape[0] > 0:
                _add(shifts[(begin + row) // group], layer[row])
        accumulate(inputs[begin:end], first, layer)
        last = hidden_layers(hidden, widths, kind, alpha, block, tilt)
        project(last, output, bias, outputs[begin:end])


@njit(**SUMS)
def backward(
    inputs: Floats,
    first: Floats,
    index: Integers,
    addresses: Integers,
    widths: Integers,
    output: Floats,
    values: Floats,
    slopes: Floats,
    grad_outputs: Floats,
    grads: Floats,
    n_entries: int,
    grad_shifts: Floats,
    grad_inputs: Floats,
    start: int,
    stop: int,
) -> None:
    """Add the gradients of some rows.

    :param grads: Of first, table, weight and bias of each layer between, output, bias; flat.
    :param n_entries: Rows of the table.
    :param grad_shifts: Like the shifts; groups of rows belong to one call.
    :param grad_inputs: Filled; shape (n, n_inputs), or empty.

    For the others see :func:`forward`.
    """
    width, total = widths[0], widths.sum()
    n_inputs = first.shape[0]
    group = inputs.shape[0] // max(grad_shifts.shape[0], 1)
    spare = np.empty((2, ROWS * widths.max()), F)
    cut = n_inputs * width
    grad_first = grads[:cut].reshape((n_inputs, width))
    grad_table = grads[cut : cut + n_entries * width].reshape((n_entries, width))
    grad_others = grads[cut + n_entries * width :]
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        grad = _backward_block(
            addresses,
            widths,
            output,
            values[begin * total : end * total],
            slopes[begin * total : end * total],
            grad_outputs[begin:end],
            grad_others,
            spare,
        )
        accumulate(inputs[begin:end].T, grad, grad_first)
        for row in range(end - begin):
            _add(grad[row], grad_table[index[begin + row]])
            if grad_shifts.shape[0] > 0:
                _add(grad[row], grad_shifts[(begin + row) // group])
        if grad_inputs.shape[0] > 0:
            project(grad, first, np.zeros(n_inputs, F), grad_inputs[begin:end])


@njit(**SUMS_INNER)
def _backward_block(
    addresses: Integers,
    widths: Integers,
    output: Floats,
    values: Floats,
    slopes: Floats,
    grad_outputs: Floats,
    grads: Floats,
    spare: Floats,
) -> Any:
    """Add the gradients of all layers but the first; yield that of what the first yields."""
    rows, n_outputs = grad_outputs.shape
    last = widths.size - 1
    begin, end, used = values.size - rows * widths[last], values.size, grads.size - n_outputs
    for row in range(rows):
        _add(grad_outputs[row], grads[used:])
    used -= n_outputs * widths[last]
    accumulate(
        grad_outputs.T,
        values[begin:end].reshape((rows, widths[last])),
        grads[used : used + n_outputs * widths[last]].reshape((n_outputs, widths[last])),
    )
    side = 0
    grad = spare[side, : rows * widths[last]].reshape((rows, widths[last]))
    _clear(grad)
    accumulate(grad_outputs, output, grad)
    for layer in range(last, 0, -1):
        n_in, n_out = widths[layer - 1], widths[layer]
        _multiply(grad.reshape(-1), slopes[begin:end])
        begin, end = begin - rows * n_in, begin
        used -= n_out
        for row in range(rows):
            _add(grad[row], grads[used : used + n_out])
        used -= n_in * n_out
        weights = grads[used : used + n_in * n_out].reshape((n_out, n_in))
        accumulate(grad.T, values[begin:end].reshape((rows, n_in)), weights)
        side = 1 - side
        below = spare[side, : rows * n_in].reshape((rows, n_in))
        _clear(below)
        accumulate(grad, carray(_floats(addresses[2 * layer - 2]), (n_out, n_in)), below)
        grad = below
    _multiply(grad.reshape(-1), slopes[begin:end])
    return grad


@njit(**SUMS_INNER)
def _multiply(values: Floats, factors: Floats) -> None:
    for i in range(values.size):
        values[i] *= factors[i]


# What time and observation contribute to the first layer of a velocity field
#
# table = (MLP(phases) + b_o) W_e^T + b,    shifts = features (W_e W_o)^T


@njit(**SUMS_INNER)
def _transposed(matrix: Any) -> Floats:
    """The transposed matrix, laid out row by row."""
    n_rows, n_columns = matrix.shape
    copy = np.empty((n_columns, n_rows), F)
    for i in range(n_columns):
        for j in range(n_rows):
            copy[i, j] = matrix[j, i]
    return copy


@njit(**SUMS_INNER)
def _product(inputs: Any, weights: Floats) -> Floats:
    product = np.empty((inputs.shape[0], weights.shape[1]), F)
    _clear(product)
    accumulate(inputs, weights, product)
    return product


@njit(**SUMS_INNER)
def _layer(inputs: Floats, weights: Floats, bias: Floats, outputs: Floats) -> None:
    """Outputs = inputs @ weights + bias."""
    for row in range(inputs.shape[0]):
        _copy(bias, outputs[row])
    accumulate(inputs, weights, outputs)


@njit(**SUMS)
def embed(
    phases: Floats,
    features: Floats,
    addresses: Integers,
    dim: int,
    kind: int,
    alpha: float,
    hidden: Floats,
    slopes: Floats,
    embeddings: Floats,
    table: Floats,
    shifts: Floats,
) -> None:
    """Evaluate the table of times and the shifts of observations.

    :param phases: Cosines and sines, shape (n_times, n_phases).
    :param features: shape (m, n_features).
    :param addresses: Of weight and bias of the time embedding's two layers, of the observation
        embedding, and of the field's first layer.
    :param dim: Dimensions of the points, the first columns of the first layer's weight.
    :param kind: Activation of the time embedding.
    :param alpha: Its parameter.
    :param hidden: Filled with the time embedding's hidden layer, shape (n_times, size).
    :param slopes: Filled with its slopes.
    :param embeddings: Filled with its outputs plus b_o, shape (n_times, size).
    :param table: Filled; shape (n_times, width).
    :param shifts: Filled; shape (m, width).
    """
    size, width, n_features = hidden.shape[1], table.shape[1], features.shape[1]
    n_phases = phases.shape[1]
    bias = carray(_floats(addresses[1]), (size,))
    _layer(phases, _transposed(carray(_floats(addresses[0]), (size, n_phases))), bias, hidden)
    activate_with_slopes(kind, F(alpha), hidden.reshape(-1), slopes.reshape(-1))
    bias = carray(_floats(addresses[3]), (size,))
    _layer(hidden, _transposed(carray(_floats(addresses[2]), (size, size))), bias, embeddings)
    observation_bias = carray(_floats(addresses[5]), (size,))
    for row in range(embeddings.shape[0]):
        _add(observation_bias, embeddings[row])
    first = _transposed(carray(_floats(addresses[6]), (width, dim + size)))[dim:]
    _layer(embeddings, first, carray(_floats(addresses[7]), (width,)), table)
    observation = carray(_floats(addresses[4]), (size, n_features))
    _clear(shifts)
    accumulate(features, _product(observation.T, first), shifts)


@njit(**SUMS)
def embed_backward(
    phases: Floats,
    features: Floats,
    addresses: Integers,
    dim: int,
    hidden: Floats,
    slopes: Floats,
    embeddings: Floats,
    grad_points: Floats,
    grad_table: Floats,
    grad_shifts: Floats,
    grads: Floats,
    grad_features: Floats,
) -> None:
    """Gradients of what :func:`embed` takes.

    :param grad_points: Of the first layer's weights of the points, shape (dim, width).
    :param grads: Filled in the order of the addresses, flat.
    :param grad_features: Filled; shape (m, n_features), or empty.

    For the others see :func:`embed`.
    """
    size, width, n_features = hidden.shape[1], grad_table.shape[1], features.shape[1]
    n_phases = phases.shape[1]
    first = carray(_floats(addresses[6]), (width, dim + size))
    of_embedding = np.empty((width, size), F)
    for row in range(width):
        _copy(first[row, dim:], of_embedding[row])
    observation = _transposed(carray(_floats(addresses[4]), (size, n_features)))
    grad_folded = _product(features.T, grad_shifts)
    grad_of_embedding = _product(grad_table.T, embeddings)
    accumulate(grad_folded.T, observation, grad_of_embedding)
    grad_embeddings = _product(grad_table, of_embedding)
    grad_hidden = _product(grad_embeddings, carray(_floats(addresses[2]), (size, size)))
    _multiply(grad_hidden.reshape(-1), slopes.reshape(-1))
    if grad_features.shape[0] > 0:
        _clear(grad_features)
        folded = _product(observation, _transposed(of_embedding))
        accumulate(grad_shifts, _transposed(folded), grad_features)

    end = _put(_product(grad_hidden.T, phases), grads, 0)
    end = _put_sums(grad_hidden, grads, end)
    end = _put(_product(grad_embeddings.T, hidden), grads, end)
    end = _put_sums(grad_embeddings, grads, end)
    end = _put(_transposed(_product(grad_folded, of_embedding)), grads, end)
    end = _put_sums(grad_embeddings, grads, end)
    for row in range(width):
        for i in range(dim):
            grads[end + i] = grad_points[i, row]
        _copy(grad_of_embedding[row], grads[end + dim :])
        end += dim + size
    _put_sums(grad_table, grads, end)


@njit(**SUMS_INNER)
def _put(matrix: Floats, target: Floats, start: int) -> int:
    """Write a matrix; say where it ends."""
    end = start + matrix.size
    _copy(matrix.reshape(-1), target[start:end])
    return end


@njit(**SUMS_INNER)
def _put_sums(matrix: Floats, target: Floats, start: int) -> int:
    """Write the sums of a matrix's columns; say where they end."""
    end = start + matrix.shape[1]
    sums = target[start:end]
    _copy(matrix[0], sums)
    for row in range(1, matrix.shape[0]):
        _add(matrix[row], sums)
    return end
