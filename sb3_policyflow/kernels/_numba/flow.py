"""The flow from latents to end points."""

from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.matrices import accumulate, clear, copy, floats, project
from sb3_policyflow.kernels._numba.mlp import hidden_layers, total
from sb3_policyflow.kernels._numba.options import ROWS, F, inner, kernel
from sb3_policyflow.kernels._numba.views import block, rows, span
from sb3_policyflow.kernels.layouts import Choice, Floats, FoldedNetwork, Method


@kernel
def flow(
    network: FoldedNetwork,
    method: Method,
    features: Floats,
    latents: Floats,
    choice: Choice,
    endpoints: Floats,
    start: int,
    stop: int,
) -> None:
    """Carry some rows of latents to their end points, or choose a latent for some rows.

    :param network: The velocity field.
    :param method: The solver.
    :param features: shape (n, n_features).
    :param latents: shape (n, dim); those to choose from have the shape (k, dim).
    :param choice: How to choose, if ``choice.latents`` has any rows.
    :param endpoints: Filled; shape (n, dim).
    :param start: The first row.
    :param stop: The row behind the last.
    """
    width, (n_latents, dim), n_values = network.widths[0], latents.shape, total(network.widths)
    chooses = choice.latents.shape[0] > 0
    step = 1 if chooses else ROWS
    most = n_latents if chooses else min(ROWS, stop - start)
    values, shifts = floats(most * n_values), floats(most * width)
    stages, scratch = floats(method.time_indices.shape[1] * most * dim), floats(2 * most * dim)
    space, densities = floats(most * dim), floats(most)
    for begin in range(start, stop, step):
        end = min(begin + step, stop)
        n_points = n_latents if chooses else end - begin
        shifts_block = block(shifts, 0, n_points, width)
        clear(shifts_block)
        accumulate(rows(features, begin, end), network.features, rows(shifts_block, 0, end - begin))
        for row in range(end - begin, n_points):
            copy(shifts_block[0], shifts_block[row])
        points, size = block(space, 0, n_points, dim), n_points * dim
        copy(span(latents, 0 if chooses else begin * dim, size), space)
        _integrate(network, method, shifts_block, points, values, stages, scratch)
        if chooses:
            chosen = _densest(points, choice, densities)
            copy(latents[chosen], choice.latents[begin])
            copy(points[chosen], endpoints[begin])
        else:
            copy(span(space, 0, size), span(endpoints, begin * dim, size))


@inner
def _densest(points: Floats, choice: Choice, densities: Floats) -> int:
    """The point around which the others lie most densely; densities are space."""
    n_points, squares = points.shape[0], F(0.0)
    for i in range(n_points):
        for j in range(i):
            squares += _squared_distance(points[i], points[j])
    if squares == F(0.0):
        return 0  # all points are the same
    # Over all pairs, squared distances add up to n times those from the mean.
    scale = squares * F(choice.bandwidth / n_points**2)
    for i in range(n_points):
        densities[i] = F(1.0)
        for j in range(i):
            density = np.exp(-_squared_distance(points[i], points[j]) / scale)
            densities[i] += density
            densities[j] += density
    densities[0] *= F(choice.first)
    chosen = 0
    for i in range(1, n_points):
        if densities[i] > densities[chosen]:
            chosen = i
    return chosen


@inner
def _squared_distance(x: Floats, y: Floats) -> Any:
    result = F(0.0)
    for column in range(x.size):
        result += (x[column] - y[column]) ** 2
    return result


@inner
def _integrate(
    network: FoldedNetwork,
    method: Method,
    shifts: Floats,
    points: Floats,
    values: Floats,
    stages: Floats,
    scratch: Floats,
) -> None:
    """Carry a block of points, in place; values, stages and scratch are space, flat."""
    n_steps, n_stages = method.time_indices.shape
    (n_rows, dim), size = points.shape, points.size
    flat, previous = span(points, 0, size), span(scratch, size, size)
    stage_points = block(scratch, 0, n_rows, dim)
    memory = method.tableau[n_stages + 1, 0]
    for step in range(n_steps):
        for stage in range(n_stages):
            _combine(flat, stages, stage, method.tableau[stage], scratch)
            time_shift = method.table[method.time_indices[step, stage]]
            velocity = block(stages, stage * size, n_rows, dim)
            _velocity(network, stage_points, shifts, time_shift, values, velocity)
        _combine(flat, stages, n_stages, method.tableau[n_stages], flat)
        if memory != F(0.0):
            _remember(flat, stages, previous, memory if step > 0 else F(0.0))


@inner
def _velocity(
    network: FoldedNetwork,
    points: Floats,
    shifts: Floats,
    time_shift: Floats,
    values: Floats,
    velocity: Floats,
) -> None:
    """Velocities of a block of points, all at the same time."""
    n_rows, width = shifts.shape
    first = block(values, 0, n_rows, width)
    for row in range(n_rows):
        for j in range(width):
            first[row, j] = shifts[row, j] + time_shift[j]
    accumulate(points, network.points, first)
    last = hidden_layers(
        network.hidden,
        network.widths,
        network.activation,
        network.alpha,
        span(values, 0, n_rows * total(network.widths)),
        span(values, 0, 0),
    )
    project(last, network.output, network.bias, velocity)


@inner
def _combine(
    points: Floats, stages: Floats, n_stages: int, weights: Floats, outputs: Floats
) -> None:
    """Outputs = points + the weighted sum of the first stages."""
    size = points.size
    for i in range(size):
        x = points[i]
        for j in range(n_stages):
            # Zero times infinity is not a number.
            if weights[j] != F(0.0):
                x += weights[j] * stages[j * size + i]
        outputs[i] = x


@inner
def _remember(points: Floats, stage: Floats, previous: Floats, memory: Any) -> None:
    """Points += memory * (stage - previous), and copy the stage for the next step."""
    for i in range(points.size):
        if memory != F(0.0):
            points[i] += memory * (stage[i] - previous[i])
        previous[i] = stage[i]
