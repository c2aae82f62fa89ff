"""MLPs, forward and backward."""

from typing import Any

from sb3_policyflow.kernels._numba.activations import activate
from sb3_policyflow.kernels._numba.matrices import (
    accumulate,
    accumulate_turned,
    add,
    clear,
    copy,
    floats,
    multiply,
    product,
    project,
    transpose,
    transposed,
    zeros,
)
from sb3_policyflow.kernels._numba.options import ROWS, F, inner, kernel
from sb3_policyflow.kernels._numba.views import block, matrix, place, rows, span, vector
from sb3_policyflow.kernels.layouts import (
    Floats,
    Integers,
    KernelInput,
    MLPGradients,
    MLPLayout,
)


@inner
def hidden_layers(
    weights: Floats,
    widths: Integers,
    activation: int,
    alpha: Any,
    values: Floats,
    derivatives: Floats,
) -> Any:
    """Carry a block of rows from the first layer to the last activation.

    :param weights: For each layer behind the first its weights (n_in, n_out) and biases, flat.
    :param widths: Outputs of each layer.
    :param activation: The activation's address.
    :param alpha: Its parameter.
    :param values: Space for the activations of all layers, flat; holds what the first layer yields.
    :param derivatives: Space for their derivatives; of size 0 if they are not wanted.
    :return: The last layer's activations, shape (rows, widths[-1]).
    """
    n_rows = values.size // total(widths)
    start, end, used = 0, n_rows * widths[0], 0
    outputs = block(values, 0, n_rows, widths[0])
    for layer in range(widths.size):
        if layer > 0:
            n_in, n_out = widths[layer - 1], widths[layer]
            start, end = end, end + n_rows * n_out
            inputs, outputs = outputs, block(values, start, n_rows, n_out)
            bias = span(weights, used + n_in * n_out, n_out)
            for row in range(n_rows):
                copy(bias, outputs[row])
            accumulate(inputs, block(weights, used, n_in, n_out), outputs)
            used += (n_in + 1) * n_out
        wanted = 0 if derivatives.size == 0 else place(derivatives, start)
        activate(activation, alpha, place(outputs, 0), wanted, outputs.size)
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
    weights = floats(size)
    end = 0
    for layer in range(1, widths.size):
        n_in, n_out = widths[layer - 1], widths[layer]
        weight = matrix(network.weights[layer], n_out, n_in)
        transpose(weight, block(weights, end, n_in, n_out))
        end += n_in * n_out
        copy(vector(network.biases[layer], n_out), span(weights, end, n_out))
        end += n_out
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
    accumulate(rows(first.points, begin, end), rows(first.weights, 0, n_points), layer)
    features = rows(first.features, begin // group, end // group)
    weights = rows(first.weights, n_points, first.weights.shape[0])
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
    table = n_inputs * width
    for row in range(begin, end):
        entry = first.entries[row] if first.entries.size > 0 else 0
        add(grad[row - begin], span(gradients.first, table + entry * width, width))
    of_points = block(gradients.first, 0, n_points, width)
    accumulate_turned(rows(first.points, begin, end), grad, of_points)
    if gradients.points.shape[0] > 0:
        no_bias = span(zeros(1, n_points), 0, n_points)
        project(grad, rows(first.weights, 0, n_points), no_bias, rows(gradients.points, begin, end))
    of_samples = grad
    if group > 1:
        of_samples = zeros((end - begin) // group, width)
        for row in range(end - begin):
            add(grad[row], of_samples[row // group])
    features = rows(first.features, begin // group, end // group)
    of_features = block(gradients.first, n_points * width, n_features, width)
    accumulate_turned(features, of_samples, of_features)
    if gradients.features.shape[0] > 0:
        grad_features = rows(gradients.features, begin // group, end // group)
        clear(grad_features)
        weights = transposed(rows(first.weights, n_points, n_inputs))
        accumulate(of_samples, weights, grad_features)


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
    workspace = floats(min(block_rows, stop - start) * n_saved)
    for begin in range(start, stop, block_rows):
        end = min(begin + block_rows, stop)
        size = (end - begin) * n_saved
        of_block, slopes = span(workspace, 0, size), span(derivatives, 0, 0)
        if derivatives.size > 0:
            of_block = span(values, begin * n_saved, size)
            slopes = span(derivatives, begin * n_saved, size)
        first_layer(first, begin, end, block(of_block, 0, end - begin, widths[0]))
        last = hidden_layers(hidden, widths, network.activation, F(network.alpha), of_block, slopes)
        project(last, weight, bias, rows(outputs, begin, end))


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
            span(values, begin * n_saved, (end - begin) * n_saved),
            span(derivatives, begin * n_saved, (end - begin) * n_saved),
            rows(grad_outputs, begin, end),
            gradients.others,
            scratch,
        )
        first_layer_backward(first, begin, end, grad, gradients)


@inner
def backward_scratch(network: MLPLayout, n_rows: int) -> Floats:
    """Space for the gradients of two layers."""
    widest = 0
    for width in network.widths:
        widest = max(widest, width)
    return floats(2 * n_rows * widest)


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
    :param scratch: Space for the gradients of two layers, flat.
    :return: The gradient of what the first layer yields, shape (n, widths[0]).
    """
    n_rows, n_out = grad_outputs.shape
    end, used = values.size, grads.size
    grad, side = grad_outputs, 0
    for layer in range(network.widths.size, 0, -1):
        n_in = network.widths[layer - 1]
        size = n_rows * n_in
        end -= size
        used -= n_out
        grad_bias = span(grads, used, n_out)
        for row in range(n_rows):
            add(grad[row], grad_bias)
        used -= n_in * n_out
        grad_weight = block(grads, used, n_out, n_in)
        accumulate_turned(grad, block(values, end, n_rows, n_in), grad_weight)
        grad_input = block(scratch, side, n_rows, n_in)
        clear(grad_input)
        accumulate(grad, matrix(network.weights[layer], n_out, n_in), grad_input)
        multiply(span(grad_input, 0, size), span(derivatives, end, size))
        grad, side, n_out = grad_input, scratch.size // 2 - side, n_in
    return grad
