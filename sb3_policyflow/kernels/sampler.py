"""The flow from latent to end point in one call of a kernel."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_policyflow.flows import SOLVERS, Solver, VelocityField, integrate
from sb3_policyflow.flows.folding import fold, integrate_folded
from sb3_policyflow.flows.solvers import AdamsBashforth2, RungeKutta, solver_times
from sb3_policyflow.kernels.compiler import kernels
from sb3_policyflow.kernels.fields import FieldParts, FusedVelocityField
from sb3_policyflow.kernels.networks import Reader
from sb3_policyflow.kernels.threads import in_parts, n_parts

Array = NDArray[Any]


class Snapshot:
    """A copy of some tensors, compared with them bit by bit.

    However they were changed, what was derived from them cannot be used by mistake.
    """

    def __init__(self) -> None:
        self._places: list[int] = []

    def renew(self, tensors: Sequence[th.Tensor]) -> bool:
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
        module: Any = kernels()
        changed: bool = module.renew(*self._arguments)
        return changed


class FlowSampler:
    """Carries latents along a velocity field, with a kernel where there is one for it.

    What the weights alone decide, such as the table of time embeddings, is kept for as long as they
    are the same.

    :param solver: Name of the solver.
    :param n_steps: Number of equal steps.
    :param end_time: Where the flow ends.
    """

    def __init__(self, solver: str, n_steps: int, end_time: float) -> None:
        self._options: dict[str, Any] = {
            "solver": solver,
            "n_steps": n_steps,
            "end_time": end_time,
        }
        self._times = solver_times(**self._options).float()
        self._stages, self._tableau = _tableau(SOLVERS[solver], n_steps, end_time)
        self._snapshot = Snapshot()
        self._parts: FieldParts | None = None

    def __reduce__(self) -> Any:
        # A copy derives what it needs from the weights that it finds.
        return type(self), tuple(self._options[name] for name in ("solver", "n_steps", "end_time"))

    def carry(self, field: VelocityField, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """End points of the flow.

        :param field: The velocity field.
        :param latents: z, shape (n, dim).
        :param features: s, shape (n, features_dim).
        :return: phi, shape (n, dim).
        """
        parts = field.parts() if type(field) is FusedVelocityField else None
        is_matrix = latents.dim() == 2 and latents.shape[:-1] == features.shape[:-1]
        if parts and is_matrix and not th.is_grad_enabled() and parts.serve(latents, features):
            return self._fused(field, parts, latents, features)
        if is_foldable(field):
            return integrate_folded(field, latents, features, **self._options)
        return integrate(
            lambda points, time: field(points, time, features), latents, **self._options
        )

    def _fused(
        self, field: VelocityField, parts: FieldParts, latents: th.Tensor, features: th.Tensor
    ) -> th.Tensor:
        module: Any = kernels()
        if self._snapshot.renew(parts.tensors) or parts is not self._parts:
            self._parts = parts
            self._network, self._method = self._derive(field, parts)
            self._work = self._stages.size * parts.network.work
        endpoints = th.empty_like(latents)
        arrays = (features.numpy(), latents.numpy(), endpoints.numpy())
        in_parts(
            len(latents),
            n_parts(len(latents), self._work),
            lambda _, start, stop: module.flow(self._network, self._method, *arrays, start, stop),
        )
        return endpoints

    @th.no_grad()
    def _derive(self, field: VelocityField, parts: FieldParts) -> tuple[Any, Any]:
        """Network and method as the kernel takes them."""
        module: Any = kernels()
        first, activation = fold(field, self._times), parts.network.activation
        between = [t for weight, bias in parts.network.layers[1:-1] for t in (weight.T, bias)]
        output = parts.network.layers[-1]
        hidden = [part.reshape(-1) for part in between]
        network = module.Network(
            points=first.points.T.contiguous().numpy(),
            features=first.features.T.contiguous().numpy(),
            hidden=(th.cat(hidden) if hidden else th.zeros(0)).numpy(),
            widths=parts.network.widths,
            output=output.weight.numpy().copy(),
            bias=output.bias.numpy().copy(),
            kind=activation.kind,
            alpha=np.float32(activation.alpha),
        )
        return network, module.Method(first.table.numpy(), self._stages, self._tableau)


def is_foldable(field: VelocityField) -> bool:
    """Whether the first layer of a field is nothing but linear, as folding it supposes."""
    reader = Reader()
    layers = (reader.layer(field.layers[0]), reader.layer(field.observation_embedding))
    is_known = type(field) in (VelocityField, FusedVelocityField) and reader.is_plain(field)
    return is_known and None not in layers


def _tableau(solver: Solver, n_steps: int, end_time: float) -> tuple[Array, Array]:
    """Where each stage of each step finds its time, and the weights of slopes: see the kernel."""
    memory = 0.0
    if isinstance(solver, AdamsBashforth2):
        # x + h (3/2 k - 1/2 k') is a step of Euler's method and half the change of the slope.
        solver, memory = SOLVERS["euler"], 0.5
    assert isinstance(solver, RungeKutta)
    n_stages = solver.evaluations
    starts = np.arange(n_steps) * solver.subdivisions
    offsets = np.array([round(node * solver.subdivisions) for node in solver.nodes])
    tableau = np.zeros((n_stages + 2, n_stages))
    for row, coefficients in enumerate((*solver.matrix, solver.weights)):
        tableau[row, : len(coefficients)] = coefficients
    tableau[-1, 0] = memory
    step = end_time / n_steps
    return starts[:, None] + offsets, (step * tableau).astype(np.float32)
