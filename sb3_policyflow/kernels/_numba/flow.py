"""The flow from latents to end points."""

from typing import Any

from sb3_policyflow.kernels._numba.matrices import accumulate, clear, copy, floats, project
from sb3_policyflow.kernels._numba.mlp import hidden_layers, total
from sb3_policyflow.kernels._numba.options import ROWS, F, inner, kernel
from sb3_policyflow.kernels._numba.views import block, rows, span
from sb3_policyflow.kernels.layouts import Floats, FoldedNetwork, Method


@kernel
def flow(
    network: FoldedNetwork,
    method: Method,
    features: Floats,
    latents: Floats,
    endpoints: Floats,
    start: int,
    stop: int,
) -> None:
    """Carry some rows of latents to their end points.

    :param network: The velocity field.
    :param method: The solver.
    :param features: shape (n, n_features).
    :param latents: shape (n, dim).
    :param endpoints: Filled; shape (n, dim).
    :param start: The first row.
    :param stop: The row behind the last.
    """
    width, dim, n_values = network.widths[0], latents.shape[1], total(network.widths)
    most = min(ROWS, stop - start)
    values, shifts = floats(most * n_values), floats(most * width)
    stages, scratch = floats(method.time_indices.shape[1] * most * dim), floats(2 * most * dim)
    for begin in range(start, stop, ROWS):
        end = min(begin + ROWS, stop)
        shifts_block = block(shifts, 0, end - begin, width)
        clear(shifts_block)
        accumulate(rows(features, begin, end), network.features, shifts_block)
        points = rows(endpoints, begin, end)
        copy(span(rows(latents, begin, end), 0, points.size), span(points, 0, points.size))
        _integrate(network, method, shifts_block, points, values, stages, scratch)


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
