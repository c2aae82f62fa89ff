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
    product,
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
def arranged(network: MLPLayout) -> Floats:
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


@inner
def rows_of_a_sample(first: KernelInput) -> int:
    """How many rows share the features of a sample."""
    return first.points.shape[0] // max(first.features.shape[0], 1)


@inner
def rows_of_a_block(first: KernelInput) -> int:
    """How many rows to carry through a network together: whole samples, and at least one."""
    group = rows_of_a_sample(first)
    return max(ROWS - ROWS % group, group)


@inner
def first_layer(first: KernelInput, begin: int, end: int, layer: Floats) -> None:
    """Evaluate the first layer of a block of whole samples, without activation."""
    n_points, group = first.points.shape[1], rows_of_a_sample(first)
    for row in range(begin, end):
        copy(first.table[first.entries[row] if first.entries.size > 0 else 0], layer[row - begin])
    accumulate(first.points[begin:end], first.weights[:n_points], layer)
    features, weights = first.features[begin // group : end // group], first.weights[n_points:]
    if group == 1:
        accumulate(features, weights, layer)
    else:
        of_samples = product(features, weights)
        for row in range(end - begin):
            add(of_samples[row // group], layer[row])


@inner
def first_layer_backward(
    first: KernelInput, begin: int, end: int, grad: Floats, gradients: MLPGradients
) -> None:
    """Add the gradients of a block's first layer.

    :param grad: Those of what it yields, shape (end - begin, h).
    """
    (n_points, n_features), width = (first.points.shape[1], first.features.shape[1]), grad.shape[1]
    n_inputs, group = n_points + n_features, rows_of_a_sample(first)
    weights = gradients.first[: n_inputs * width].reshape((n_inputs, width))
    table = gradients.first[n_inputs * width :]
    for row in range(begin, end):
        entry = first.entries[row] if first.entries.size > 0 else 0
        add(grad[row - begin], table[entry * width : (entry + 1) * width])
    accumulate(first.points[begin:end].T, grad, weights[:n_points])
    if gradients.points.shape[0] > 0:
        no_bias = np.zeros(n_points, F)
        project(grad, first.weights[:n_points], no_bias, gradients.points[begin:end])
    of_samples = grad
    if group > 1:
        of_samples = np.zeros(((end - begin) // group, width), F)
        for row in range(end - begin):
            add(grad[row], of_samples[row // group])
    features = first.features[begin // group : end // group]
    accumulate(features.T, of_samples, weights[n_points:])
    if gradients.features.shape[0] > 0:
        grad_features = gradients.features[begin // group : end // group]
        clear(grad_features)
        accumulate(of_samples, transposed(first.weights[n_points:]), grad_features)


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
    :param start: The first row of a sample.
    :param stop: The row behind the last of a sample.
    """
    widths, n_saved, block_rows = network.widths, total(network.widths), rows_of_a_block(first)
    hidden = arranged(network)
    weight = matrix(network.weights[-1], outputs.shape[1], widths[-1])
    bias = vector(network.biases[-1], outputs.shape[1])
    workspace = np.empty(min(block_rows, stop - start) * n_saved, F)
    for begin in range(start, stop, block_rows):
        end = min(begin + block_rows, stop)
        block = workspace[: (end - begin) * n_saved]
        derivatives_block = derivatives[begin * n_saved : end * n_saved]
        if derivatives.size > 0:
            block = values[begin * n_saved : end * n_saved]
        layer = block[: (end - begin) * widths[0]].reshape((end - begin, widths[0]))
        first_layer(first, begin, end, layer)
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
    :param gradients: Added to; rows of a sample belong to one call.
    :param start: The first row of a sample.
    :param stop: The row behind the last of a sample.
    """
    n_saved, block_rows = total(network.widths), rows_of_a_block(first)
    scratch = backward_scratch(network, min(block_rows, stop - start))
    for begin in range(start, stop, block_rows):
        end = min(begin + block_rows, stop)
        grad = backward_block(
            network,
            values[begin * n_saved : end * n_saved],
            derivatives[begin * n_saved : end * n_saved],
            grad_outputs[begin:end],
            gradients.others,
            scratch,
        )
        first_layer_backward(first, begin, end, grad, gradients)


@inner
def backward_scratch(network: MLPLayout, rows: int) -> Floats:
    """Space for the gradients of two layers."""
    widest = 0
    for width in network.widths:
        widest = max(widest, width)
    return np.empty((2, rows * widest), F)


@inner
def backward_block(
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
