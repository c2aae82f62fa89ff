"""The flow from latent to end point in one call of a kernel."""

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_policyflow.flows import (
    SOLVERS,
    FourierTimeEmbedding,
    Solver,
    VelocityField,
    integrate,
)
from sb3_policyflow.flows.folding import fold, integrate_folded
from sb3_policyflow.flows.solvers import AdamsBashforth2, RungeKutta, solver_times
from sb3_policyflow.fused.compiler import kernels, note_fallback
from sb3_policyflow.fused.networks import (
    Perceptron,
    is_plain,
    is_served,
    linear_parameters,
    read_perceptron,
)
from sb3_policyflow.fused.threads import in_parts

Array = NDArray[Any]


class Snapshot:
    """A copy of some tensors, compared with them bit by bit.

    However they were changed, what was derived from them cannot be used by mistake.
    """

    def __init__(self) -> None:
        self._copy = np.zeros(0, dtype=np.int32)

    def renew(self, tensors: Sequence[th.Tensor]) -> bool:
        """Copy the tensors, and say whether the copy was out of date."""
        sizes = [tensor.numel() for tensor in tensors]
        is_new = len(self._copy) != sum(sizes)
        if is_new:
            self._copy = np.zeros(sum(sizes), dtype=np.int32)
        addresses = [tensor.data_ptr() for tensor in tensors]
        module: Any = kernels()
        changed: bool = module.renew(np.array(addresses), np.array(sizes), self._copy)
        return changed or is_new


class FlowSampler:
    """Carries latents along a velocity field, with a kernel where there is one for it.

    What the weights alone decide, such as the table of time embeddings, is kept for as long as they
    are the same.

    :param solver: Name of the solver.
    :param n_steps: Number of equal steps.
    :param end_time: Where the flow ends.
    """

    def __init__(self, solver: str, n_steps: int, end_time: float) -> None:
        self._solver, self._n_steps, self._end_time = solver, n_steps, end_time
        self._times = solver_times(solver, n_steps, end_time).float()
        self._stages, self._tableau = _tableau(SOLVERS[solver], n_steps, end_time)
        self._snapshot = Snapshot()

    def carry(self, field: VelocityField, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """End points of the flow.

        :param field: The velocity field.
        :param latents: z, shape (n, dim).
        :param features: s, shape (n, features_dim).
        :return: phi, shape (n, dim).
        """
        endpoints = None if th.is_grad_enabled() else self._fused(field, latents, features)
        if endpoints is not None:
            return endpoints
        options = {"n_steps": self._n_steps, "solver": self._solver, "end_time": self._end_time}
        if is_foldable(field):
            return integrate_folded(field, latents, features, **options)
        return integrate(lambda points, time: field(points, time, features), latents, **options)

    def _fused(
        self, field: VelocityField, latents: th.Tensor, features: th.Tensor
    ) -> th.Tensor | None:
        """End points by a kernel, or None if it does not serve the field or the tensors."""
        module, network = kernels(), read_field(field)
        if module is None or network is None:
            return None
        tensors, perceptron = network
        if not is_served(latents, features, *tensors):
            note_fallback("some tensors are not contiguous float32 in memory")
            return None
        if self._snapshot.renew(tensors):
            self._weights, self._widths, self._table = _arrange(field, perceptron, self._times)
        endpoints = th.empty_like(latents)
        kind = getattr(module, perceptron.activation.name)
        arguments = (
            self._weights,
            self._widths,
            kind,
            perceptron.activation.alpha,
            self._table,
            self._stages,
            self._tableau,
            features.detach().numpy(),
            latents.detach().numpy(),
            endpoints.numpy(),
        )
        in_parts(
            len(latents),
            self._stages.size * len(self._weights),
            lambda start, stop: module.flow(*arguments, start, stop),
        )
        return endpoints


def read_field(field: VelocityField) -> tuple[list[th.Tensor], Perceptron] | None:
    """All that a field's velocity depends on, and its MLP; None if it is not of the kind served."""
    embedding = field.time_embedding
    perceptron = read_perceptron(chain(_children(field.hidden), (field.output,)))
    observation = linear_parameters(field.observation_embedding)
    time = read_perceptron(_children(embedding.mlp))
    is_known = type(field) is VelocityField and type(embedding) is FourierTimeEmbedding
    containers = (field, field.hidden, embedding, embedding.mlp)
    if (
        not (is_known and all(map(is_plain, containers)))
        or perceptron is None
        or len(perceptron.parameters) < 2
        or observation is None
        or time is None
    ):
        note_fallback(f"{type(field).__name__} has layers, activations or hooks of another kind")
        return None
    layers = chain(time.parameters, (observation,), perceptron.parameters)
    return [embedding.frequencies, *chain.from_iterable(layers)], perceptron


def is_foldable(field: VelocityField) -> bool:
    """Whether the first layer of a field is nothing but linear, as folding it supposes."""
    folded = (field.layers[0], field.observation_embedding)
    has_known_layers = all(linear_parameters(layer) is not None for layer in folded)
    return type(field) is VelocityField and has_known_layers and is_plain(field)


def _children(module: nn.Module) -> Iterable[nn.Module]:
    return module._modules.values()  # type: ignore[return-value]  # none of ours is None


def _arrange(
    field: VelocityField, perceptron: Perceptron, times: th.Tensor
) -> tuple[Array, Array, Array]:
    """Weights, widths and table as the kernel takes them."""
    with th.no_grad():
        first = fold(field, times)
        parts = [first.points.T, first.features.T]
        for weight, bias in perceptron.parameters[1:-1]:
            parts += [weight.T, bias]
        parts += perceptron.parameters[-1]
        weights = th.cat([part.reshape(-1) for part in parts])
    widths = [len(bias) for _, bias in perceptron.parameters[:-1]]
    return weights.numpy(), np.array(widths), first.table.numpy()


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
