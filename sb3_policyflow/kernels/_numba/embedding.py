"""What time and observation contribute to the first layer of a velocity field.

table = (MLP(cos, sin of 2 pi f t) + b_o) W_e^T + b,    shifts = features (W_e W_o)^T
"""

import math

import numpy as np

from sb3_policyflow.kernels._numba.activations import activate_with_slopes
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
from sb3_policyflow.kernels._numba.options import F, Floats, Integers, inner, kernel


@inner
def _tell_apart(times: Floats, index: Integers) -> int:
    """Move each distinct time to the front; fill the index of each time; count the distinct."""
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
        index[row] = slots[slot]
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
def embed(
    times: Floats,
    index: Integers,
    n_frequencies: int,
    features: Floats,
    addresses: Integers,
    dim: int,
    kind: int,
    alpha: float,
    kept: Floats,
    table: Floats,
    shifts: Floats,
) -> int:
    """Evaluate the table of times and the shifts of observations.

    :param times: shape (n_times,); the distinct ones are moved to the front.
    :param index: Filled with the entry of the table for each time, shape (n_times,).
    :param n_frequencies: Frequencies of the time embedding.
    :param features: shape (m, n_features).
    :param addresses: Of the frequencies, of weight and bias of the time embedding's two layers, of
        the observation embedding, and of the field's first layer.
    :param dim: Dimensions of the points, the first columns of the first layer's weight.
    :param kind: Activation of the time embedding.
    :param alpha: Its parameter.
    :param kept: Filled with the time embedding's hidden layer, its slopes, and the embeddings plus
        b_o, shape (3, n_times, size).
    :param table: Filled; shape (n_times, width).
    :param shifts: Filled; shape (m, width).
    :return: How many distinct times, and entries of the table, there are.
    """
    n = _tell_apart(times, index)
    size, width = kept.shape[2], table.shape[1]
    hidden, slopes, embeddings = kept[0, :n], kept[1, :n], kept[2, :n]
    phases = _phases(times[:n], vector(addresses[0], n_frequencies))
    weights = transposed(matrix(addresses[1], size, 2 * n_frequencies))
    _layer(phases, weights, vector(addresses[2], size), hidden)
    activate_with_slopes(kind, F(alpha), hidden.reshape(-1), slopes.reshape(-1))
    weights = transposed(matrix(addresses[3], size, size))
    _layer(hidden, weights, vector(addresses[4], size), embeddings)
    for row in range(n):
        add(vector(addresses[6], size), embeddings[row])
    first = transposed(matrix(addresses[7], width, dim + size))[dim:]
    _layer(embeddings, first, vector(addresses[8], width), table[:n])
    clear(shifts)
    observation = matrix(addresses[5], size, features.shape[1])
    accumulate(features, product(observation.T, first), shifts)
    return n


@kernel
def embed_backward(
    times: Floats,
    n_frequencies: int,
    features: Floats,
    addresses: Integers,
    dim: int,
    kept: Floats,
    grad_points: Floats,
    grad_table: Floats,
    grad_shifts: Floats,
    grads: Floats,
    grad_features: Floats,
) -> None:
    """Gradients of what :func:`embed` takes.

    :param times: The distinct times.
    :param grad_points: Of the first layer's weights of the points, shape (dim, width).
    :param grads: Filled in the order of the addresses behind the first, flat.
    :param grad_features: Filled; shape (m, n_features), or empty.

    For the others see :func:`embed`.
    """
    n, width, size, n_features = times.size, grad_table.shape[1], kept.shape[2], features.shape[1]
    hidden, slopes, embeddings = kept[0, :n], kept[1, :n], kept[2, :n]
    first = matrix(addresses[7], width, dim + size)
    of_embedding = np.empty((width, size), F)
    for row in range(width):
        copy(first[row, dim:], of_embedding[row])
    observation = transposed(matrix(addresses[5], size, n_features))
    grad_folded = product(features.T, grad_shifts)
    grad_of_embedding = product(grad_table.T, embeddings)
    accumulate(grad_folded.T, observation, grad_of_embedding)
    grad_embeddings = product(grad_table, of_embedding)
    grad_hidden = product(grad_embeddings, matrix(addresses[3], size, size))
    multiply(grad_hidden.reshape(-1), slopes.reshape(-1))
    if grad_features.shape[0] > 0:
        clear(grad_features)
        folded = product(observation, transposed(of_embedding))
        accumulate(grad_shifts, transposed(folded), grad_features)

    phases = _phases(times, vector(addresses[0], n_frequencies))
    end = _put(product(grad_hidden.T, phases), grads, 0)
    end = _put_sums(grad_hidden, grads, end)
    end = _put(product(grad_embeddings.T, hidden), grads, end)
    end = _put_sums(grad_embeddings, grads, end)
    end = _put(transposed(product(grad_folded, of_embedding)), grads, end)
    end = _put_sums(grad_embeddings, grads, end)
    for row in range(width):
        for i in range(dim):
            grads[end + i] = grad_points[i, row]
        copy(grad_of_embedding[row], grads[end + dim :])
        end += dim + size
    _put_sums(grad_table, grads, end)


@inner
def _put(values: Floats, target: Floats, start: int) -> int:
    """Write a matrix; say where it ends."""
    copy(values.reshape(-1), target[start:])
    return start + values.size


@inner
def _put_sums(values: Floats, target: Floats, start: int) -> int:
    """Write the sums of a matrix's columns; say where they end."""
    end = start + values.shape[1]
    copy(values[0], target[start:end])
    for row in range(1, values.shape[0]):
        add(values[row], target[start:end])
    return end
