"""Velocity fields evaluated by kernels."""

from itertools import chain
from typing import Any, NamedTuple

import torch as th

from sb3_policyflow.flows import FourierTimeEmbedding, VelocityField
from sb3_policyflow.flows.folding import FirstLayer as FoldedLayer, fold
from sb3_policyflow.fused.compiler import kernels, note_fallback
from sb3_policyflow.fused.networks import Layer, Perceptron, Reader, Reading, in_memory
from sb3_policyflow.fused.perceptron import FirstLayer, evaluate

MANY = 2**20


class FieldParts(NamedTuple):
    """What a velocity field consists of, and all tensors that it depends on."""

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
        table, index = self._tabulate(times, leading)
        folded = fold(self, table)
        if features.shape[:-1] not in (leading, (*leading[:-1], 1)):
            features = features.expand(*leading, -1)
        first = FirstLayer(
            points.reshape(-1, points.shape[-1]),
            folded.points,
            folded.table,
            index,
            features.reshape(-1, features.shape[-1]) @ folded.features.T,
        )
        return evaluate(first, parts.network).view_as(points)

    def _tabulate(self, times: th.Tensor, leading: th.Size) -> tuple[th.Tensor, th.Tensor]:
        """Times without their repetitions, and for each row of a shape which it has."""
        table = times.reshape(-1)
        index = th.arange(len(table))
        if len(table) * self.observation_embedding.out_features**2 > MANY:
            table, index = th.unique(table, return_inverse=True)
        return table, index.view_as(times).expand(leading).reshape(-1)
