"""MLPs, forward and backward."""

from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.activations import activate, activate_with_derivatives
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
from sb3_policyflow.kernels._numba.options import ROWS, F, inner, kernel
from sb3_policyflow.kernels.layouts import (
    Floats,
    Integers,
    KernelInput,
    MLPGradients,
    MLPLayout,
)


@inner
def hidden_layers(
    weights: Floats, widths: Integers, kind: int, alpha: Any, values: Floats, derivatives: Floats
) -> Any:
    """Carry a block of rows from the first layer to the last activation.

    :param weights: For each layer behind the first its weights (n_in, n_out) and biases, flat.
    :param widths: Outputs of each layer.
    :param kind: The activation.
    :param alpha: Its parameter.
    :param values: Space for the activations of all layers, flat; holds what the first layer yields.
    :param derivatives: Space for their derivatives; of size 0 if they are not wanted.
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
        if derivatives.size > 0:
            activate_with_derivatives(kind, alpha, values[start:end], derivatives[start:end])
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
def _arrange(network: MLPLayout) -> Floats:
    """Copy what lies between first layer and output, as :func:`hidden_layers` takes it."""
    widths = network.widths
    size = 0
    for layer in range(1, widths.size):
        size += (widths[layer - 1] + 1) * widths[layer]
    weights = np.empty(size, F)
    end = 0
    for layer in range(1, widths.size):
        n_in, n_out = widths[layer - 1], widths[layer]
        weight = transposed(matrix(network.weights[layer], n_out, n_in))
        copy(weight.reshape(-1), weights[end:])
        copy(vector(network.biases[layer], n_out), weights[end + n_in * n_out :])
        end += (n_in + 1) * n_out
    return weights


@kernel
def forward(
    first: KernelInput,
    network: MLPLayout,
    outputs: Floats,
    values: Floats,
    derivatives: Floats,
    start: int,
    stop: int,
) -> None:
    """Evaluate an MLP on some rows.

    :param first: The first layer.
    :param network: The MLP.
    :param outputs: Filled; shape (n, n_outputs).
    :param values: Filled with the activations of all hidden layers for :func:`backward`, block by
        block, n * sum(widths); or empty.
    :param derivatives: Likewise with their derivatives.
    :param start: The first row.
    :param stop: The row behind the last.
    """
    points, entries, shifts, widths = first.points, first.entries, first.shifts, network.widths
    width, n_saved, n_outputs = widths[0], total(widths), outputs.shape[1]
    weight_points = transposed(
        matrix(network.weights[0], width, first.stride)[:, : points.shape[1]]
    )
    hidden = _arrange(network)
    weight = matrix(network.weights[-1], n_outputs, widths[-1])
    bias = vector(network.biases[-1], n_outputs)
    workspace = np.empty(min(ROWS, stop - start) * n_saved, F)
    group = points.shape[0] // max(shifts.shape[0], 1)
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        block = workspace[: (end - begin) * n_saved]
        derivatives_block = derivatives[begin * n_saved : end * n_saved]
        if derivatives.size > 0:
            block = values[begin * n_saved : end * n_saved]
        layer = block[: (end - begin) * width].reshape((end - begin, width))
        for row in range(begin, end):
            copy(first.table[entries[row] if entries.size > 0 else 0], layer[row - begin])
            if shifts.shape[0] > 0:
                add(shifts[row // group], layer[row - begin])
        accumulate(points[begin:end], weight_points, layer)
        last = hidden_layers(
            hidden, widths, network.kind, F(network.alpha), block, derivatives_block
        )
        project(last, weight, bias, outputs[begin:end])


@kernel
def backward(
    first: KernelInput,
    network: MLPLayout,
    values: Floats,
    derivatives: Floats,
    grad_outputs: Floats,
    gradients: MLPGradients,
    start: int,
    stop: int,
) -> None:
    """Add the gradients of some rows.

    :param first: The first layer.
    :param network: The MLP.
    :param values: What :func:`forward` filled.
    :param derivatives: Likewise.
    :param grad_outputs: The gradient of the outputs, shape (n, n_outputs).
    :param gradients: Added to; groups of rows that share a shift belong to one call.
    :param start: The first row.
    :param stop: The row behind the last.
    """
    points, entries, widths = first.points, first.entries, network.widths
    width, n_saved, n_points = widths[0], total(widths), points.shape[1]
    n_entries, n_shifts = first.table.shape[0], gradients.shifts.shape[0]
    group = points.shape[0] // max(n_shifts, 1)
    widest = 0
    for layer_width in widths:
        widest = max(widest, layer_width)
    scratch = np.empty((2, min(ROWS, stop - start) * widest), F)
    table_start, table_end = n_points * width, (n_points + n_entries) * width
    grad_first = gradients.parameters[:table_start].reshape((n_points, width))
    grad_table = gradients.parameters[table_start:table_end].reshape((n_entries, width))
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        grad = _backward_block(
            network,
            values[begin * n_saved : end * n_saved],
            derivatives[begin * n_saved : end * n_saved],
            grad_outputs[begin:end],
            gradients.parameters[table_end:],
            scratch,
        )
        accumulate(points[begin:end].T, grad, grad_first)
        for row in range(begin, end):
            add(grad[row - begin], grad_table[entries[row] if entries.size > 0 else 0])
            if n_shifts > 0:
                add(grad[row - begin], gradients.shifts[row // group])
        if gradients.points.shape[0] > 0:
            weight = matrix(network.weights[0], width, first.stride)[:, :n_points]
            no_bias = np.zeros(n_points, F)
            project(grad, transposed(weight), no_bias, gradients.points[begin:end])


@inner
def _backward_block(
    network: MLPLayout,
    values: Floats,
    derivatives: Floats,
    grad_outputs: Floats,
    grads: Floats,
    scratch: Floats,
) -> Any:
    """Add the gradients of all layers but the first.

    :param grads: Those of weight and bias of each layer behind the first, flat.
    :param scratch: Space for the gradients of two layers, shape (2, rows * the widest).
    :return: The gradient of what the first layer yields, shape (rows, widths[0]).
    """
    rows, n_out = grad_outputs.shape
    end, used = values.size, grads.size
    grad, side = grad_outputs, 0
    for layer in range(network.widths.size, 0, -1):
        n_in = network.widths[layer - 1]
        begin = end - rows * n_in
        used -= n_out
        for row in range(rows):
            add(grad[row], grads[used : used + n_out])
        used -= n_in * n_out
        grad_weight = grads[used : used + n_in * n_out].reshape((n_out, n_in))
        accumulate(grad.T, values[begin:end].reshape((rows, n_in)), grad_weight)
        grad_input = scratch[side, : rows * n_in].reshape((rows, n_in))
        clear(grad_input)
        accumulate(grad, matrix(network.weights[layer], n_out, n_in), grad_input)
        multiply(grad_input.reshape(-1), derivatives[begin:end])
        grad, side, end, n_out = grad_input, 1 - side, begin, n_in
    return grad
