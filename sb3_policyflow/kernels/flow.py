"""The flow from latents to end points in one call of a kernel."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th

from sb3_policyflow.flows import SOLVERS, Solver, VelocityField
from sb3_policyflow.flows.folding import fold
from sb3_policyflow.flows.solvers import AdamsBashforth2, RungeKutta, solver_times
from sb3_policyflow.kernels.layouts import Floats, FoldedNetwork, Integers, Kernels, Method
from sb3_policyflow.kernels.mlp import MLP
from sb3_policyflow.kernels.threads import in_parts, n_parts

if TYPE_CHECKING:  # that module imports this one
    from sb3_policyflow.kernels.fields import FieldParts

MAX_PLANS = 8
"""Solvers that a field keeps plans for at the same time."""


class FlowPlan(NamedTuple):
    """A field and a solver as the kernel takes them: what the weights alone decide."""

    kernels: Kernels
    network: FoldedNetwork
    method: Method
    flops_per_row: int

    def transport(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Carry latents (n, dim) with features (n, features_dim) to their end points (n, dim)."""
        endpoints = th.empty_like(latents)
        network, method, run = self.network, self.method, self.kernels.flow
        arrays = (features.numpy(), latents.numpy(), endpoints.numpy())
        in_parts(
            len(latents),
            n_parts(len(latents), self.flops_per_row),
            lambda _, start, stop: run(network, method, *arrays, start, stop),
        )
        return endpoints


class FlowPlans:
    """The plans of a field, kept for as long as its weights are the same.

    A copy has no plans: it derives them from the weights that it finds.
    """

    def __init__(self) -> None:
        self._snapshot = Snapshot()
        self._parts: FieldParts | None = None
        self._plans: dict[tuple[str, int, float], FlowPlan] = {}

    def __reduce__(self) -> Any:
        return type(self), ()

    def get(
        self, field: VelocityField, parts: "FieldParts", solver: str, n_steps: int, end_time: float
    ) -> FlowPlan:
        """Return the plan for a solver.

        :param field: The velocity field.
        :param parts: Its parts, as they are now.
        :param solver: Name of the solver.
        :param n_steps: Number of equal steps.
        :param end_time: Where the flow ends.
        :raises ValueError: If the solver is unknown or ``n_steps`` is less than 1.
        """
        is_outdated = self._snapshot.update(parts.kernels, parts.tensors)
        if is_outdated or parts is not self._parts:
            self._parts = parts
            self._plans.clear()
        key = (solver, n_steps, end_time)
        plan = self._plans.get(key)
        if plan is None:
            if len(self._plans) == MAX_PLANS:
                self._plans.clear()
            plan = self._plans[key] = _make_plan(field, parts.network, *key)
        return plan


class Snapshot:
    """A copy of some tensors, compared with them bit by bit.

    However they were changed, what was derived from them cannot be used by mistake.
    """

    def __init__(self) -> None:
        self._places: list[int] = []

    def update(self, kernels: Kernels, tensors: Sequence[th.Tensor]) -> bool:
        """Copy the tensors, and say whether the copy was out of date."""
        places = [tensor.data_ptr() for tensor in tensors]
        if places != self._places:
            sizes = [tensor.numel() for tensor in tensors]
            self._places = places
            self._arguments = (
                np.array(places),
                np.array(sizes),
                np.full(sum(sizes), -1, dtype=np.int32),
            )
        return kernels.update_copy(*self._arguments)


@th.no_grad()
def _make_plan(
    field: VelocityField, network: MLP, solver: str, n_steps: int, end_time: float
) -> FlowPlan:
    times = solver_times(solver, n_steps, end_time).float()
    time_indices, tableau = _tableau(SOLVERS[solver], n_steps, end_time)
    first, output = fold(field, times), network.layers[-1]
    between = [t for weight, bias in network.layers[1:-1] for t in (weight.T, bias)]
    hidden = [part.reshape(-1) for part in between]
    folded = FoldedNetwork(
        points=first.points.T.contiguous().numpy(),
        features=first.features.T.contiguous().numpy(),
        hidden=(th.cat(hidden) if hidden else th.zeros(0)).numpy(),
        widths=network.widths,
        output=output.weight.numpy().copy(),
        bias=output.bias.numpy().copy(),
        kind=network.activation.kind,
        alpha=np.float32(network.activation.alpha),
    )
    method = Method(first.table.numpy(), time_indices, tableau)
    return FlowPlan(network.kernels, folded, method, time_indices.size * network.flops_per_row)


def _tableau(solver: Solver, n_steps: int, end_time: float) -> tuple[Integers, Floats]:
    """``time_indices`` and ``tableau`` of a :class:`Method`."""
    memory = 0.0
    if isinstance(solver, AdamsBashforth2):
        # x + h (3/2 k - 1/2 k') is a step of Euler's method and half the change of the velocity.
        solver, memory = SOLVERS["euler"], 0.5
    assert isinstance(solver, RungeKutta)
    n_stages, n_parts = solver.n_stages, solver.grid_points_per_step
    starts = np.arange(n_steps) * n_parts
    offsets = np.array([round(node * n_parts) for node in solver.nodes])
    tableau = np.zeros((n_stages + 2, n_stages))
    for row, coefficients in enumerate((*solver.matrix, solver.weights)):
        tableau[row, : len(coefficients)] = coefficients
    tableau[-1, 0] = memory
    step = end_time / n_steps
    return starts[:, None] + offsets, (step * tableau).astype(np.float32)
