"""The flow from latents to end points."""

from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.matrices import accumulate, clear, copy, project
from sb3_policyflow.kernels._numba.mlp import hidden_layers, total
from sb3_policyflow.kernels._numba.options import ROWS, F, inner, kernel
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
    values = np.empty(most * n_values, F)
    shifts = np.empty((most, width), F)
    stages = np.empty((method.time_indices.shape[1], most, dim), F)
    scratch = np.empty((2, most, dim), F)
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
            stages[:, :rows],
            scratch[:, :rows],
        )


@inner
def _integrate(
    network: FoldedNetwork,
    method: Method,
    shifts: Floats,
    points: Floats,
    values: Floats,
    stages: Any,
    scratch: Any,
) -> None:
    """Carry a block of points, in place."""
    n_steps, n_stages = method.time_indices.shape
    stage_points, previous = scratch[0], scratch[1]
    memory = method.tableau[n_stages + 1, 0]
    for step in range(n_steps):
        for stage in range(n_stages):
            _combine(points, stages[:stage], method.tableau[stage], stage_points)
            time_shift = method.table[method.time_indices[step, stage]]
            _velocity(network, stage_points, shifts, time_shift, values, stages[stage])
        _combine(points, stages, method.tableau[n_stages], points)
        if memory != F(0.0):
            _remember(points, stages[0], previous, memory if step > 0 else F(0.0))


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
def _combine(points: Floats, stages: Any, weights: Floats, outputs: Floats) -> None:
    """Outputs = points + the weighted sum of the stages."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            x = points[row, i]
            for j in range(stages.shape[0]):
                # Zero times infinity is not a number.
                if weights[j] != F(0.0):
                    x += weights[j] * stages[j, row, i]
            outputs[row, i] = x


@inner
def _remember(points: Floats, stage: Any, previous: Any, memory: Any) -> None:
    """Points += memory * (stage - previous), and copy the stage for the next step."""
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            if memory != F(0.0):
                points[row, i] += memory * (stage[row, i] - previous[row, i])
            previous[row, i] = stage[row, i]
