"""Velocity fields evaluated and differentiated by kernels."""

import math
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch.autograd.function import once_differentiable

from sb3_policyflow.flows import FourierTimeEmbedding, VelocityField
from sb3_policyflow.fused.compiler import kernels, note_fallback
from sb3_policyflow.fused.networks import (
    Activation,
    Layer,
    Perceptron,
    Reader,
    Reading,
    in_memory,
)
from sb3_policyflow.fused.perceptron import FirstLayer, Gradients, Pass

FEW = 32
"""Times among which it does not pay to look for repetitions."""


class FieldParts(NamedTuple):
    """What a velocity field consists of, and all tensors that it depends on.

    The tensors are the frequencies and the parameters of the time embedding (four), of the
    observation embedding (two) and of the network.
    """

    time: Perceptron
    observation: Layer
    network: Perceptron
    tensors: list[th.Tensor]


def read_field(reader: Reader, field: VelocityField) -> FieldParts | None:
    """The parts of a field, or None if it is not of the kind that kernels know."""
    embedding = field.time_embedding
    containers = (field, field.hidden, embedding, embedding.mlp)
    reader.children(field)
    network = reader.perceptron((*reader.children(field.hidden), field.output))
    observation = reader.layer(field.observation_embedding)
    reader.children(embedding)
    time = reader.perceptron(reader.children(embedding.mlp))
    if (
        not isinstance(field, VelocityField)
        or type(embedding) is not FourierTimeEmbedding
        or not all([reader.is_plain(module) for module in containers])
        or network is None
        or observation is None
        or time is None
        or len(time.layers) != 2
    ):
        note_fallback(f"{type(field).__name__} has layers, activations or hooks of another kind")
        return None
    layers = chain(time.layers, (observation,), network.layers)
    tensors = [embedding.frequencies, *chain.from_iterable(layers)]
    return FieldParts(time, observation, network, tensors)


class FusedVelocityField(VelocityField):
    """A :class:`VelocityField` that kernels evaluate where they can."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._reading = Reading(read_field)

    def parts(self) -> FieldParts | None:
        """What the field consists of, or None if kernels cannot work on it."""
        parts = self._reading.of(self)
        if parts is None or kernels() is None:
            return None
        if not in_memory(parts.tensors):
            note_fallback("parameters are not contiguous float32 on the CPU")
            return None
        return parts

    def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
        parts = self.parts()
        if parts is None or times.requires_grad or not in_memory((points, times, features)):
            return super().forward(points, times, features)
        leading = points.shape[:-1]
        if features.shape[:-1] not in (leading, (*leading[:-1], 1)):
            features = features.expand(*leading, -1)
        activations = (parts.time.activation, parts.network.activation)
        velocity: th.Tensor = _FieldEvaluation.apply(
            activations,
            *self._tabulate(times, leading),
            points.reshape(-1, points.shape[-1]),
            features.reshape(-1, features.shape[-1]),
            *parts.tensors,
        )
        return velocity.view_as(points)

    def _tabulate(self, times: th.Tensor, leading: th.Size) -> tuple[th.Tensor, th.Tensor]:
        """Times without their repetitions, and for each row of a shape which it has."""
        table = times.reshape(-1)
        index = th.arange(len(table))
        if len(table) > FEW:
            table, index = th.unique(table, return_inverse=True)
        return table, index.view_as(times).expand(leading).reshape(-1)


class _Embedding:
    """What time and observation contribute to a field's first layer, and the way back.

    :param activation: Activation of the time embedding.
    :param times: shape (n_times,).
    :param features: shape (m, features_dim).
    :param tensors: Those of the field, see :class:`FieldParts`.
    """

    def __init__(
        self,
        activation: Activation,
        times: th.Tensor,
        features: th.Tensor,
        tensors: list[th.Tensor],
    ) -> None:
        weight, bias = tensors[7:9]
        n_times, width, size = len(times), len(bias), len(tensors[6])
        self._dim = weight.shape[1] - size
        phases = times.unsqueeze(-1) * (2 * math.pi * tensors[0])
        phases = th.cat([phases.cos(), phases.sin()], dim=-1)
        self._inputs = (phases.numpy(), features.numpy())
        self._kept = features.new_empty(3, n_times, size).numpy()
        self.table = features.new_empty(n_times, width)
        self.shifts = features.new_empty(len(features), width)
        module: Any = kernels()
        module.embed(
            *self._inputs,
            _addresses(tensors),
            self._dim,
            getattr(module, activation.name),
            activation.alpha,
            *self._kept,
            self.table.numpy(),
            self.shifts.numpy(),
        )

    def back(
        self, tensors: list[th.Tensor], rows: Gradients, needs_features: bool
    ) -> tuple[th.Tensor | None, tuple[th.Tensor, ...]]:
        """Gradients of the features, and of the parameters up to the first layer.

        :param tensors: Those of the field again.
        :param rows: Gradients of the first layer.
        :param needs_features: Whether those of the features are wanted.
        """
        sizes = [tensor.numel() for tensor in tensors[1:9]]
        flat = rows.table.new_empty(sum(sizes))
        features = self._inputs[1]
        grad_features = flat.new_empty(features.shape if needs_features else (0, 0))
        module: Any = kernels()
        module.embed_backward(
            *self._inputs,
            _addresses(tensors),
            self._dim,
            *self._kept,
            rows.weight.T.numpy(),
            rows.table.numpy(),
            rows.shifts.numpy(),
            flat.numpy(),
            grad_features.numpy(),
        )
        return grad_features if needs_features else None, flat.split(sizes)


def _addresses(tensors: list[th.Tensor]) -> Any:
    return np.array([tensor.data_ptr() for tensor in tensors[1:9]])


class _FieldEvaluation(th.autograd.Function):
    """A velocity field as a node of autograd's graph."""

    @staticmethod
    def forward(
        ctx: Any,
        activations: tuple[Activation, Activation],
        times: th.Tensor,
        index: th.Tensor,
        points: th.Tensor,
        features: th.Tensor,
        *tensors: th.Tensor,
    ) -> th.Tensor:
        keeps = any(ctx.needs_input_grad)
        embedding = _Embedding(activations[0], times, features, list(tensors))
        weight = tensors[7][:, : points.shape[1]]
        first = FirstLayer(points, weight, embedding.table, index, embedding.shifts)
        way = Pass(activations[1], first, list(tensors[9:]), keeps)
        if keeps:
            ctx.embedding, ctx.way, ctx.first = embedding, way, first
            ctx.save_for_backward(*tensors)
        return way.outputs

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        tensors = ctx.saved_tensors
        needs_points, needs_features = ctx.needs_input_grad[3:5]
        rows = ctx.way.back(ctx.first, tensors[9:], grad_outputs, needs_points)
        features, others = ctx.embedding.back(tensors, rows, needs_features)
        grads = [g.view_as(t) for g, t in zip(others, tensors[1:9], strict=True)]
        return None, None, None, rows.inputs, features, None, *grads, *rows.others
