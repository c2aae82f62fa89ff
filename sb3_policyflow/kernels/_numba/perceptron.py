"""Perceptrons, forwards and backwards."""

from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.activations import activate, activate_with_slopes
from sb3_policyflow.kernels._numba.matrices import (
    accumulate,
    add,
    clear,
    copy,
    multiply,
    project,
    transposed,
)
from sb3_policyflow.kernels._numba.memory import matrix, vector
from sb3_policyflow.kernels._numba.options import ROWS, F, Floats, Integers, inner, kernel


@inner
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
    rows = values.size // total(widths)
    start, end, used = 0, rows * widths[0], 0
    outputs = values[:end].reshape((rows, widths[0]))
    for layer in range(widths.size):
        if layer > 0:
            n_in, n_out = widths[layer - 1], widths[layer]
            start, end = end, end + rows * n_out
            inputs, outputs = outputs, values[start:end].reshape((rows, n_out))
            weight_end = used + n_in * n_out
            for row in range(rows):
                copy(weights[weight_end : weight_end + n_out], outputs[row])
            accumulate(inputs, weights[used:weight_end].reshape((n_in, n_out)), outputs)
            used = weight_end + n_out
        if slopes.size > 0:
            activate_with_slopes(kind, alpha, values[start:end], slopes[start:end])
        else:
            activate(kind, alpha, values[start:end])
    return outputs


@inner
def total(widths: Integers) -> int:
    """Sum of all widths."""
    result = 0
    for width in widths:
        result += width
    return result


@inner
def _arrange(addresses: Integers, widths: Integers) -> Floats:
    """What lies between first layer and output, as :func:`hidden_layers` takes it."""
    size = 0
    for layer in range(1, widths.size):
        size += (widths[layer - 1] + 1) * widths[layer]
    weights = np.empty(size, F)
    end = 0
    for layer in range(1, widths.size):
        n_in, n_out = widths[layer - 1], widths[layer]
        weight = transposed(matrix(addresses[2 * layer], n_out, n_in))
        copy(weight.reshape(-1), weights[end:])
        copy(vector(addresses[2 * layer + 1], n_out), weights[end + n_in * n_out :])
        end += (n_in + 1) * n_out
    return weights


@kernel
def forward(
    inputs: Floats,
    stride: int,
    table: Floats,
    index: Integers,
    shifts: Floats,
    addresses: Integers,
    widths: Integers,
    kind: int,
    alpha: float,
    outputs: Floats,
    values: Floats,
    slopes: Floats,
    start: int,
    stop: int,
) -> None:
    """Evaluate a network on some rows.

    The first layer is inputs @ W^T + table[index] + shifts, where each shift serves as many rows
    as there are to each.

    :param inputs: shape (n, n_inputs).
    :param stride: Columns of the first layer's weight, of which the first n_inputs are W.
    :param table: shape (n_entries, widths[0]).
    :param index: Entry of the table for each row, shape (n,); if empty, all have the first.
    :param shifts: shape (m, widths[0]) where m divides n, or m = 0.
    :param addresses: Of weight (n_out, n_in) and bias of each layer.
    :param widths: Outputs of each layer but the last.
    :param kind: The activation.
    :param alpha: Its parameter.
    :param outputs: Filled; shape (n, n_outputs).
    :param values: Filled with what :func:`backward` needs, n * sum(widths); or empty.
    :param slopes: Likewise.
    :param start: The first row.
    :param stop: The row behind the last.
    """
    width, n_kept, n_outputs = widths[0], total(widths), outputs.shape[1]
    first = transposed(matrix(addresses[0], width, stride)[:, : inputs.shape[1]])
    hidden = _arrange(addresses, widths)
    weight = matrix(addresses[-2], n_outputs, widths[-1])
    bias = vector(addresses[-1], n_outputs)
    room = np.empty(ROWS * n_kept, F)
    group = inputs.shape[0] // max(shifts.shape[0], 1)
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        block, tilt = room[: (end - begin) * n_kept], slopes[begin * n_kept : end * n_kept]
        if slopes.size > 0:
            block = values[begin * n_kept : end * n_kept]
        layer = block[: (end - begin) * width].reshape((end - begin, width))
        for row in range(begin, end):
            copy(table[index[row] if index.size > 0 else 0], layer[row - begin])
            if shifts.shape[0] > 0:
                add(shifts[row // group], layer[row - begin])
        accumulate(inputs[begin:end], first, layer)
        last = hidden_layers(hidden, widths, kind, F(alpha), block, tilt)
        project(last, weight, bias, outputs[begin:end])


@kernel
def backward(
    inputs: Floats,
    stride: int,
    index: Integers,
    addresses: Integers,
    widths: Integers,
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

    :param grads: Of W^T, the table, and weight and bias of each layer behind the first; flat.
    :param n_entries: Rows of the table.
    :param grad_shifts: Like the shifts; groups of rows belong to one call.
    :param grad_inputs: Filled; shape (n, n_inputs), or empty.

    For the others see :func:`forward`.
    """
    width, n_kept, n_inputs = widths[0], total(widths), inputs.shape[1]
    group = inputs.shape[0] // max(grad_shifts.shape[0], 1)
    widest = 0
    for layer_width in widths:
        widest = max(widest, layer_width)
    spare = np.empty((2, ROWS * widest), F)
    table_start, table_end = n_inputs * width, (n_inputs + n_entries) * width
    grad_first = grads[:table_start].reshape((n_inputs, width))
    grad_table = grads[table_start:table_end].reshape((n_entries, width))
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        grad = _backward_block(
            addresses,
            widths,
            values[begin * n_kept : end * n_kept],
            slopes[begin * n_kept : end * n_kept],
            grad_outputs[begin:end],
            grads[table_end:],
            spare,
        )
        accumulate(inputs[begin:end].T, grad, grad_first)
        for row in range(begin, end):
            add(grad[row - begin], grad_table[index[row] if index.size > 0 else 0])
            if grad_shifts.shape[0] > 0:
                add(grad[row - begin], grad_shifts[row // group])
        if grad_inputs.shape[0] > 0:
            first = transposed(matrix(addresses[0], width, stride)[:, :n_inputs])
            project(grad, first, np.zeros(n_inputs, F), grad_inputs[begin:end])


@inner
def _backward_block(
    addresses: Integers,
    widths: Integers,
    values: Floats,
    slopes: Floats,
    grad_outputs: Floats,
    grads: Floats,
    spare: Floats,
) -> Any:
    """Add the gradients of all layers but the first; yield that of what the first yields."""
    rows, n_out = grad_outputs.shape
    end, used = values.size, grads.size
    grad, side = grad_outputs, 0
    for layer in range(widths.size, 0, -1):
        n_in = widths[layer - 1]
        begin = end - rows * n_in
        used -= n_out
        for row in range(rows):
            add(grad[row], grads[used : used + n_out])
        used -= n_in * n_out
        grad_weight = grads[used : used + n_in * n_out].reshape((n_out, n_in))
        accumulate(grad.T, values[begin:end].reshape((rows, n_in)), grad_weight)
        below = spare[side, : rows * n_in].reshape((rows, n_in))
        clear(below)
        accumulate(grad, matrix(addresses[2 * layer], n_out, n_in), below)
        multiply(below.reshape(-1), slopes[begin:end])
        grad, side, end, n_out = below, 1 - side, begin, n_in
    return grad
