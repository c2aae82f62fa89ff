"""Velocity fields evaluated and differentiated by kernels."""

import math
from itertools import chain
from typing import Any, NamedTuple

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
from sb3_policyflow.fused.perceptron import FirstLayer, Pass

MANY = 2**20
"""Work of embedding times for which it pays to look for repetitions among them."""


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
        if parts is None or not in_memory((points, times, features)):
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
        if len(table) * self.observation_embedding.out_features**2 > MANY:
            table, index = th.unique(table, return_inverse=True)
        return table, index.view_as(times).expand(leading).reshape(-1)


class _Embedding:
    """What time and observation contribute to a field's first layer, and the way back.

    table = (t_emb(times) + b_o) W_e^T + b,    shifts = features (W_e W_o)^T

    :param activation: Activation of the time embedding.
    :param times: shape (n_times,).
    :param features: shape (m, features_dim).
    :param tensors: Those of the field, see :class:`FieldParts`.
    :param keeps: Whether to keep what the way back needs.
    """

    def __init__(
        self,
        activation: Activation,
        times: th.Tensor,
        features: th.Tensor,
        tensors: list[th.Tensor],
        keeps: bool,
    ) -> None:
        frequencies, *self._time, self._weight, bias, weight, first_bias = tensors[:9]
        phases = 2 * math.pi * times.unsqueeze(-1) * frequencies
        self._phases = th.cat([phases.cos(), phases.sin()], dim=-1)
        self._way = Pass(activation, self._time_layer(), self._time[2:], keeps)
        dim = weight.shape[1] - len(bias)
        self.of_points, self._of_embedding = weight[:, :dim], weight[:, dim:]
        self._embeddings = self._way.outputs.add_(bias)
        self.table = th.addmm(first_bias, self._embeddings, self._of_embedding.T)
        self._folded = self._of_embedding @ self._weight
        self._features = features
        self.shifts = features @ self._folded.T

    def _time_layer(self) -> FirstLayer:
        weight, bias = self._time[:2]
        n_times = len(self._phases)
        index = th.zeros(n_times, dtype=th.int64)
        return FirstLayer(
            self._phases, weight, bias.view(1, -1), index, bias.new_empty(0, len(bias))
        )

    def back(
        self, grad_table: th.Tensor, grad_shifts: th.Tensor, needs_features: bool
    ) -> tuple[th.Tensor | None, list[th.Tensor], th.Tensor]:
        """Gradients of features, of all tensors up to the first layer, and of its part W_e."""
        grad_folded = grad_shifts.T @ self._features
        grad_embeddings = grad_table @ self._of_embedding
        time = self._way.back(self._time_layer(), self._time[2:], grad_embeddings)
        grad_of_embedding = grad_table.T @ self._embeddings
        grad_of_embedding.addmm_(grad_folded, self._weight.T)
        return (
            grad_shifts @ self._folded if needs_features else None,
            [
                time.weight.contiguous(),
                time.table.view(-1),
                *time.others,
                self._of_embedding.T @ grad_folded,
                grad_embeddings.sum(0),
            ],
            grad_of_embedding,
        )


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
        embedding = _Embedding(activations[0], times, features, list(tensors), keeps)
        first = FirstLayer(points, embedding.of_points, embedding.table, index, embedding.shifts)
        way = Pass(activations[1], first, list(tensors[9:]), keeps)
        if keeps:
            ctx.embedding, ctx.way, ctx.index = embedding, way, index
            ctx.save_for_backward(points, *tensors)
        return way.outputs

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        points, *tensors = ctx.saved_tensors
        embedding: _Embedding = ctx.embedding
        first = FirstLayer(
            points, embedding.of_points, embedding.table, ctx.index, embedding.shifts
        )
        needs_points, needs_features = ctx.needs_input_grad[3:5]
        grads = ctx.way.back(first, tensors[9:], grad_outputs, needs_points)
        features, up_to_first, of_embedding = embedding.back(
            grads.table, grads.shifts, needs_features
        )
        weight = th.cat([grads.weight, of_embedding], dim=1)
        bias = grads.table.sum(0)
        return (
            None,
            None,
            None,
            grads.inputs,
            features,
            None,
            *up_to_first,
            weight,
            bias,
            *grads.others,
        )
