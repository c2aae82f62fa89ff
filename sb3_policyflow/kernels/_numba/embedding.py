"""A velocity field up to its first layer, as a table of times and weights of points and features.

table = (MLP(cos, sin of 2 pi f t) + b_o) W_e^T + b,    weights = [W_x, W_e W_o]^T
"""

import math

import numpy as np

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
    transpose,
    transposed,
    zeros,
)
from sb3_policyflow.kernels._numba.options import F, inner, kernel
from sb3_policyflow.kernels._numba.views import bits, block, matrix, place, rows, span, vector
from sb3_policyflow.kernels.layouts import (
    FieldLayout,
    FirstLayer,
    Floats,
    Integers,
)


@inner
def _deduplicate(times: Floats, entries: Integers) -> int:
    """Move the distinct times to the front, fill the entry of each time, and count the distinct."""
    bits_of, size = bits(place(times, 0), times.size), 64
    while size < 2 * times.size:
        size *= 2
    slots = np.empty(size, np.int64)
    for i in range(size):
        slots[i] = -1
    count = 0
    for row in range(times.size):
        slot = (np.int64(bits_of[row]) * 2654435761 >> 15) & (size - 1)
        while slots[slot] >= 0 and bits_of[slots[slot]] != bits_of[row]:
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
    size, width, table = first.hidden.shape[1], first.table.shape[1], rows(first.table, 0, n)
    hidden, embeddings = rows(first.hidden, 0, n), rows(first.embeddings, 0, n)
    phases = rows(first.phases, 0, n)
    _fill_phases(span(times, 0, n), vector(field.frequencies, field.n_frequencies), phases)
    weights = transposed(matrix(field.time_hidden_weight, size, 2 * field.n_frequencies))
    _layer(phases, weights, vector(field.time_hidden_bias, size), hidden)
    activate(
        field.activation, F(field.alpha), place(hidden, 0), place(first.derivatives, 0), hidden.size
    )
    weights = transposed(matrix(field.time_output_weight, size, size))
    _layer(hidden, weights, vector(field.time_output_bias, size), embeddings)
    for row in range(n):
        add(vector(field.observation_bias, size), embeddings[row])
    first_weights = transposed(matrix(field.first_weight, width, dim + size))
    of_embedding = rows(first_weights, dim, dim + size)
    _layer(embeddings, of_embedding, vector(field.first_bias, width), table)
    copy(span(first_weights, 0, dim * width), span(first.weights, 0, dim * width))
    n_features = first.weights.shape[0] - dim
    observation = matrix(field.observation_weight, size, n_features)
    folded = rows(first.weights, dim, dim + n_features)
    clear(folded)
    accumulate_turned(observation, of_embedding, folded)
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
    n_features, n_weights = first.weights.shape[0] - dim, first.weights.size
    n_inputs = dim + size
    n = (grad_first.size - n_weights) // width
    grad_points = block(grad_first, 0, dim, width)
    grad_folded = block(grad_first, dim * width, n_features, width)
    grad_table = block(grad_first, n_weights, n, width)
    phases, hidden = rows(first.phases, 0, n), rows(first.hidden, 0, n)
    first_weight = matrix(field.first_weight, width, n_inputs)
    of_embedding = block(floats(width * size), 0, width, size)
    for row in range(width):
        copy(span(first_weight, row * n_inputs + dim, size), of_embedding[row])
    grad_embeddings = product(grad_table, of_embedding)
    grad_hidden = product(grad_embeddings, matrix(field.time_output_weight, size, size))
    multiply(span(grad_hidden, 0, n * size), span(first.derivatives, 0, n * size))

    end = _fill_gradients(grad_hidden, phases, grads, 0)
    end = _fill_gradients(grad_embeddings, hidden, grads, end)
    sums = span(grads, end - size, size)
    grad_observation = product(grad_folded, of_embedding)
    transpose(grad_observation, block(grads, end, size, n_features))
    end += size * n_features
    copy(sums, span(grads, end, size))
    end += size
    observation = transposed(matrix(field.observation_weight, size, n_features))
    grad_of_embedding = zeros(width, size)
    accumulate_turned(grad_table, rows(first.embeddings, 0, n), grad_of_embedding)
    accumulate_turned(grad_folded, observation, grad_of_embedding)
    grad_first_weight = block(grads, end, width, n_inputs)
    for row in range(width):
        for i in range(dim):
            grad_first_weight[row, i] = grad_points[i, row]
        copy(grad_of_embedding[row], span(grad_first_weight, row * n_inputs + dim, size))
    _fill_sums(grad_table, span(grads, end + width * n_inputs, width))


@inner
def _fill_gradients(grad_outputs: Floats, inputs: Floats, grads: Floats, start: int) -> int:
    """Fill gradients of a layer's weights and bias, and say where they end."""
    n_out, n_in = grad_outputs.shape[1], inputs.shape[1]
    of_weights = block(grads, start, n_out, n_in)
    clear(of_weights)
    accumulate_turned(grad_outputs, inputs, of_weights)
    _fill_sums(grad_outputs, span(grads, start + n_out * n_in, n_out))
    return start + n_out * (n_in + 1)


@inner
def _fill_sums(values: Floats, sums: Floats) -> None:
    """Sums of a matrix's columns."""
    copy(values[0], sums)
    for row in range(1, values.shape[0]):
        add(values[row], sums)
