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
def _fill_phases(times: Floats, frequencies: Floats, outputs: Floats) -> None:
    """Cosines and sines, shape (n_times, 2 n_frequencies)."""
    n_frequencies = frequencies.size
    for row in range(times.size):
        for i in range(n_frequencies):
            phase = F(2 * math.pi) * times[row] * frequencies[i]
            outputs[row, i] = math.cos(phase)
            outputs[row, n_frequencies + i] = math.sin(phase)


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
    phases = first.phases[:n]
    _fill_phases(times[:n], vector(field.frequencies, field.n_frequencies), phases)
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
    field: FieldLayout, first: FirstLayer, grad_first: Floats, grads: Floats
) -> None:
    """Gradients of what :func:`embed` takes.

    :param field: The embeddings and the first layer.
    :param first: What :func:`embed` filled.
    :param grad_first: Those of the first layer's weights (dim + n_features, h) and table
        (n_distinct, h), flat.
    :param grads: Filled with those of the parameters in :class:`FieldLayout`, flat, in its order.
    """
    dim, size, width = field.dim, first.hidden.shape[1], first.table.shape[1]
    n_features, n_phases = first.weights.shape[0] - dim, first.phases.shape[1]
    n_weights, n_inputs = first.weights.size, dim + size
    n = (grad_first.size - n_weights) // width
    grad_points = grad_first[: dim * width].reshape((dim, width))
    grad_folded = grad_first[dim * width : n_weights].reshape((n_features, width))
    grad_table = grad_first[n_weights:].reshape((n, width))
    phases, hidden, derivatives = first.phases[:n], first.hidden[:n], first.derivatives[:n]
    first_weight = matrix(field.first_weight, width, n_inputs)
    of_embedding = np.empty((width, size), F)
    for row in range(width):
        copy(first_weight[row, dim:], of_embedding[row])
    grad_embeddings = product(grad_table, of_embedding)
    grad_hidden = product(grad_embeddings, matrix(field.time_output_weight, size, size))
    multiply(grad_hidden.reshape(-1), derivatives.reshape(-1))

    end = size * n_phases
    _fill_product(grad_hidden.T, phases, grads[:end].reshape((size, n_phases)))
    start, end = end, end + size
    _fill_sums(grad_hidden, grads[start:end])
    start, end = end, end + size * size
    _fill_product(grad_embeddings.T, hidden, grads[start:end].reshape((size, size)))
    start, end = end, end + size
    sums = grads[start:end]
    _fill_sums(grad_embeddings, sums)
    start, end = end, end + size * n_features
    copy(transposed(product(grad_folded, of_embedding)).reshape(-1), grads[start:end])
    start, end = end, end + size
    copy(sums, grads[start:end])
    start, end = end, end + width * n_inputs
    observation = transposed(matrix(field.observation_weight, size, n_features))
    grad_of_embedding = product(grad_table.T, first.embeddings[:n])
    accumulate(grad_folded.T, observation, grad_of_embedding)
    grad_first_weight = grads[start:end].reshape((width, n_inputs))
    for row in range(width):
        for i in range(dim):
            grad_first_weight[row, i] = grad_points[i, row]
        copy(grad_of_embedding[row], grad_first_weight[row, dim:])
    _fill_sums(grad_table, grads[end : end + width])


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
