"""The flow from latents to end points."""

from typing import Any, NamedTuple

import numpy as np

from sb3_policyflow.kernels._numba.matrices import accumulate, clear, copy, project
from sb3_policyflow.kernels._numba.options import ROWS, F, Floats, Integers, inner, kernel
from sb3_policyflow.kernels._numba.perceptron import hidden_layers, total


class Network(NamedTuple):
    """A velocity field whose first layer is taken apart.

    Weights of the first layer for points (dim, widths[0]) and features (n_features, widths[0]);
    what lies between first layer and output, see :func:`hidden_layers`, and the layers' widths;
    weights (dim, widths[-1]) and biases of the output; the activation and its parameter.
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


@kernel
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
    width, dim, n_values = network.widths[0], latents.shape[1], total(network.widths)
    values = np.empty(ROWS * n_values, F)
    shifts = np.empty((ROWS, width), F)
    slopes = np.empty((method.stages.shape[1], ROWS, dim), F)
    spare = np.empty((2, ROWS, dim), F)
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        rows = end - begin
        clear(shifts[:rows])
        accumulate(features[begin:end], network.features, shifts[:rows])
        for row in range(begin, end):
            copy(latents[row], endpoints[row])
        _integrate(
            network,
            method,
            shifts[:rows],
            endpoints[begin:end],
            values[: rows * n_values],
            slopes[:, :rows],
            spare[:, :rows],
        )


@inner
def _integrate(
    network: Network,
    method: Method,
    shifts: Floats,
    points: Floats,
    values: Floats,
    slopes: Any,
    spare: Any,
) -> None:
    """Carry a block of points, in place."""
    n_steps, n_stages = method.stages.shape
    looked, previous = spare[0], spare[1]
    memory = method.tableau[n_stages + 1, 0]
    for step in range(n_steps):
        for stage in range(n_stages):
            _combine(points, slopes[:stage], method.tableau[stage], looked)
            time_shift = method.table[method.stages[step, stage]]
            _velocity(network, looked, shifts, time_shift, values, slopes[stage])
        _combine(points, slopes, method.tableau[n_stages], points)
        if memory != F(0.0):
            _remember(points, slopes[0], previous, memory if step > 0 else F(0.0))


@inner
def _velocity(
    network: Network,
    points: Floats,
    shifts: Floats,
    time_shift: Floats,
    values: Floats,
    velocity: Floats,
) -> None:
    """Velocities of a block of points, all at the same time."""
    rows, width = shifts.shape
    first = values[: rows * width].reshape((rows, width))
    for row in range(rows):
        for j in range(width):
            first[row, j] = shifts[row, j] + time_shift[j]
    accumulate(points, network.points, first)
    last = hidden_layers(
        network.hidden, network.widths, network.kind, network.alpha, values, values[:0]
    )
    project(last, network.output, network.bias, velocity)


@inner
def _combine(points: Floats, slopes: Any, weights: Floats, outputs: Floats) -> None:
    """Outputs = points + the weighted sum of the slopes."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            x = points[row, i]
            for j in range(slopes.shape[0]):
                # Zero times infinity is not a number.
                if weights[j] != F(0.0):
                    x += weights[j] * slopes[j, row, i]
            outputs[row, i] = x


@inner
def _remember(points: Floats, slopes: Any, previous: Any, memory: Any) -> None:
    """Points += memory * (slopes - previous), and the slopes are the next previous ones."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            if memory != F(0.0):
                points[row, i] += memory * (slopes[row, i] - previous[row, i])
            previous[row, i] = slopes[row, i]
