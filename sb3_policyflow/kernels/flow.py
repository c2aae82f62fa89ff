"""The flow from latents to end points in one call of a kernel."""

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_policyflow.flows import SOLVERS, Solver
from sb3_policyflow.flows.folding import split_first_layer
from sb3_policyflow.flows.modes import FIRST, relative_bandwidth
from sb3_policyflow.flows.solvers import AdamsBashforth2, RungeKutta, solver_times
from sb3_policyflow.flows.velocity import fourier_features
from sb3_policyflow.kernels.field_parts import FieldParts
from sb3_policyflow.kernels.inspection import addresses
from sb3_policyflow.kernels.layouts import Choice, Floats, FoldedNetwork, Integers, Kernels, Method
from sb3_policyflow.kernels.threads import in_parts, n_parts

MAX_PLANS = 8
"""Solvers that a field keeps plans for at the same time."""
NO_CHOICE = Choice(np.empty((0, 0), dtype=np.float32), 0.0, 0.0)
"""For latents that are given."""


class FlowPlan(NamedTuple):
    """A field and a solver as the kernel takes them: what the weights alone decide."""

    kernels: Kernels
    network: FoldedNetwork
    method: Method
    flops_per_row: int

    def transport(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Carry latents (n, dim) with features (n, features_dim) to their end points (n, dim)."""
        endpoints = np.empty(latents.shape, dtype=np.float32)
        self._run(features, latents, NO_CHOICE, endpoints, self.flops_per_row)
        return th.from_numpy(endpoints)

    def choose_latents(
        self, candidates: th.Tensor, features: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Choose among candidates (k, dim) with features (n, features_dim), each (n, dim)."""
        k, dim = candidates.shape
        # Arrays of NumPy's are made in half the time that tensors take.
        chosen, endpoints = (np.empty((len(features), dim), dtype=np.float32) for _ in range(2))
        choice = Choice(chosen, relative_bandwidth(k, dim), FIRST)
        self._run(features, candidates, choice, endpoints, k * self.flops_per_row)
        return th.from_numpy(chosen), th.from_numpy(endpoints)

    def _run(
        self,
        features: th.Tensor,
        latents: th.Tensor,
        choice: Choice,
        endpoints: Floats,
        flops_per_row: int,
    ) -> None:
        """Call the kernel, on several threads if it pays."""
        network, method, run = self.network, self.method, self.kernels.flow
        arrays = (features.numpy(), latents.numpy(), choice, endpoints)
        in_parts(
            len(features),
            n_parts(len(features), flops_per_row),
            lambda _, start, stop: run(network, method, *arrays, start, stop),
        )


class FlowPlans:
    """The plans of a field, kept for as long as its weights are the same.

    A copy has no plans: it derives them from the weights that it finds. Threads may share plans:
    they change by one assignment.
    """

    def __init__(self) -> None:
        self._snapshot: _Snapshot | None = None

    def __reduce__(self) -> Any:
        return type(self), ()

    def get(self, parts: FieldParts, solver: str, n_steps: int, end_time: float) -> FlowPlan:
        """Return the plan for a solver.

        :param parts: The parts of the field, as they are now.
        :param solver: Name of the solver.
        :param n_steps: Number of equal steps.
        :param end_time: Where the flow ends.
        :raises ValueError: If the solver is unknown or ``n_steps`` is less than 1.
        """
        snapshot = self._snapshot
        if snapshot is None or not snapshot.is_current(parts):
            snapshot = self._snapshot = _Snapshot(parts)
        return snapshot.plan(solver, n_steps, end_time)


class _Snapshot:
    """A copy of a field's weights, and the plans that were derived from this copy.

    The weights are compared with it bit by bit: however they were changed, what was derived from
    others cannot be used by mistake. They may change while they are copied. Then the copy is a
    mixture, and the next comparison says so.

    :param parts: The parts of the field.
    """

    def __init__(self, parts: FieldParts) -> None:
        self._parts = parts
        self._copies = [tensor.clone() for tensor in parts.held]
        self._arguments = (
            addresses(parts.held),
            addresses(self._copies),
            np.array([tensor.numel() for tensor in parts.held]),
        )
        self._plans: dict[tuple[str, int, float], FlowPlan] = {}

    def is_current(self, parts: FieldParts) -> bool:
        """Whether the field has these parts and they are what they were."""
        return parts is self._parts and parts.kernels.are_same(*self._arguments)

    def plan(self, solver: str, n_steps: int, end_time: float) -> FlowPlan:
        """Return the plan for a solver, see :meth:`FlowPlans.get`."""
        key = (solver, n_steps, end_time)
        plan = self._plans.get(key)
        if plan is None:
            plan = _make_plan(self._parts, self._copies, *key)
            if len(self._plans) >= MAX_PLANS:
                self._plans.clear()
            self._plans[key] = plan
        return plan


@th.no_grad()
def _make_plan(
    parts: FieldParts, weights: list[th.Tensor], solver: str, n_steps: int, end_time: float
) -> FlowPlan:
    """Make a plan for a solver.

    :param parts: What the field consists of.
    :param weights: A copy of its tensors, of which nothing changes.
    """
    network, linear = parts.network, th.nn.functional.linear
    frequencies, time_weight, time_bias, output_weight, output_bias = weights[:5]
    observation_weight, observation_bias, first_weight, first_bias = weights[5:9]
    times = solver_times(solver, n_steps, end_time).float()
    time_indices, tableau = _tableau(SOLVERS[solver], n_steps, end_time)
    hidden = linear(fourier_features(times, frequencies), time_weight, time_bias)
    embeddings = linear(parts.time.modules[1](hidden), output_weight, output_bias)
    first = split_first_layer(
        parts.dim, first_weight, first_bias, observation_weight, embeddings + observation_bias
    )
    *between, weight, bias = weights[9:]
    flat = [(part.T if part.dim() == 2 else part).reshape(-1) for part in between]
    folded = FoldedNetwork(
        points=first.points.T.contiguous().numpy(),
        features=first.features.T.contiguous().numpy(),
        hidden=th.cat(flat).numpy() if flat else np.zeros(0, dtype=np.float32),
        widths=network.widths,
        output=weight.numpy(),
        bias=bias.numpy(),
        activation=network.layout.activation,
        alpha=np.float32(network.layout.alpha),
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
