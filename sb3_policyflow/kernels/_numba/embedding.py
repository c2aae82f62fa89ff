"""A velocity field up to its first layer, as a table of times and weights of points and features.

table = (MLP(cos, sin of 2 pi f t) + b_o) W_e^T + b,    weights = [W_x, W_e W_o]^T
"""

import math
from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.activations import activate_with_derivatives
from sb3_policyflow.kernels._numba.matrices import (
    accumulate,
    add,
    clear,
    copy,
    multiply,
    product,
    transposed,
)
from sb3_policyflow.kernels._numba.memory import matrix, vector
from sb3_policyflow.kernels._numba.options import F, inner, kernel
from sb3_policyflow.kernels.layouts import (
    FieldGradients,
    FieldLayout,
    FirstLayer,
    Floats,
    Integers,
)


@inner
def _deduplicate(times: Floats, entries: Integers) -> int:
    """Move the distinct times to the front, fill the entry of each time, and count the distinct."""
    bits = times.view(np.int32)
    size = 64
    while size < 2 * times.size:
        size *= 2
    slots = np.full(size, -1, np.int64)
    count = 0
    for row in range(times.size):
        slot = (np.int64(bits[row]) * 2654435761 >> 15) & (size - 1)
        while slots[slot] >= 0 and bits[slots[slot]] != bits[row]:
            slot = (slot + 1) & (size - 1)
        if slots[slot] < 0:
            slots[slot] = count
            times[count] = times[row]
            count += 1
        entries[row] = slots[slot]
    return count


@inner
def _phases(times: Floats, frequencies: Floats) -> Floats:
    """Cosines and sines, shape (n_times, 2 n_frequencies)."""
    n_frequencies = frequencies.size
    outputs = np.empty((times.size, 2 * n_frequencies), F)
    for row in range(times.size):
        for i in range(n_frequencies):
            phase = F(2 * math.pi) * times[row] * frequencies[i]
            outputs[row, i] = math.cos(phase)
            outputs[row, n_frequencies + i] = math.sin(phase)
    return outputs


@inner
def _layer(inputs: Floats, weights: Floats, bias: Floats, outputs: Floats) -> None:
    """Outputs = inputs @ weights + bias."""
    for row in range(inputs.shape[0]):
        copy(bias, outputs[row])
    accumulate(inputs, weights, outputs)


@kernel
def embed(times: Floats, field: FieldLayout, first: FirstLayer) -> int:
    """Evaluate a field up to what points and features contribute to its first layer.

    :param times: shape (n_times,); the distinct ones are moved to the front.
    :param field: The embeddings and the first layer.
    :param first: Filled; the table is as long as there are distinct times.
    :return: How many distinct times there are.
    """
    n, dim = _deduplicate(times, first.entries), field.dim
    size, width, table = first.hidden.shape[1], first.table.shape[1], first.table[:n]
    hidden, derivatives, embeddings = first.hidden[:n], first.derivatives[:n], first.embeddings[:n]
    phases = _phases(times[:n], vector(field.frequencies, field.n_frequencies))
    weights = transposed(matrix(field.time_hidden_weight, size, 2 * field.n_frequencies))
    _layer(phases, weights, vector(field.time_hidden_bias, size), hidden)
    activate_with_derivatives(
        field.kind, F(field.alpha), hidden.reshape(-1), derivatives.reshape(-1)
    )
    weights = transposed(matrix(field.time_output_weight, size, size))
    _layer(hidden, weights, vector(field.time_output_bias, size), embeddings)
    for row in range(n):
        add(vector(field.observation_bias, size), embeddings[row])
    first_weights = transposed(matrix(field.first_weight, width, dim + size))
    of_embedding = first_weights[dim:]
    _layer(embeddings, of_embedding, vector(field.first_bias, width), table)
    for i in range(dim):
        copy(first_weights[i], first.weights[i])
    observation = matrix(field.observation_weight, size, first.weights.shape[0] - dim)
    _fill_product(transposed(observation), of_embedding, first.weights[dim:])
    return n


@kernel
def embed_backward(
    times: Floats, field: FieldLayout, first: FirstLayer, gradients: FieldGradients
) -> None:
    """Gradients of what :func:`embed` takes.

    :param times: The distinct times, shape (n_times,).
    :param field: The embeddings and the first layer.
    :param first: What :func:`embed` filled.
    :param gradients: Of the first layer, and filled.
    """
    n, dim, (width, n_inputs) = times.size, field.dim, gradients.first_weight.shape
    size, n_features = n_inputs - dim, gradients.weights.shape[0] - dim
    hidden, derivatives, embeddings = first.hidden[:n], first.derivatives[:n], first.embeddings[:n]
    first_weight = matrix(field.first_weight, width, n_inputs)
    of_embedding = np.empty((width, size), F)
    for row in range(width):
        copy(first_weight[row, dim:], of_embedding[row])
    observation = transposed(matrix(field.observation_weight, size, n_features))
    grad_folded = gradients.weights[dim:]
    grad_of_embedding = product(transposed(gradients.table), embeddings)
    accumulate(transposed(grad_folded), observation, grad_of_embedding)
    grad_embeddings = product(gradients.table, of_embedding)
    grad_hidden = product(grad_embeddings, matrix(field.time_output_weight, size, size))
    multiply(grad_hidden.reshape(-1), derivatives.reshape(-1))

    phases = _phases(times, vector(field.frequencies, field.n_frequencies))
    _fill_product(transposed(grad_hidden), phases, gradients.time_hidden_weight)
    _fill_sums(grad_hidden, gradients.time_hidden_bias)
    _fill_product(transposed(grad_embeddings), hidden, gradients.time_output_weight)
    _fill_sums(grad_embeddings, gradients.time_output_bias)
    copy(
        transposed(product(grad_folded, of_embedding)).reshape(-1),
        gradients.observation_weight.reshape(-1),
    )
    copy(gradients.time_output_bias, gradients.observation_bias)
    for row in range(width):
        for i in range(dim):
            gradients.first_weight[row, i] = gradients.weights[i, row]
        copy(grad_of_embedding[row], gradients.first_weight[row, dim:])
    _fill_sums(gradients.table, gradients.first_bias)


@inner
def _fill_product(inputs: Any, weights: Floats, outputs: Floats) -> None:
    """Outputs = inputs @ weights."""
    clear(outputs)
    accumulate(inputs, weights, outputs)


@inner
def _fill_sums(values: Floats, sums: Floats) -> None:
    """Sums of a matrix's columns."""
    copy(values[0], sums)
    for row in range(1, values.shape[0]):
        add(values[row], sums)
