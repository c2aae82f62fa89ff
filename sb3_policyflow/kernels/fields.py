"""Velocity fields evaluated and differentiated by kernels."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_policyflow.flows import FourierTimeEmbedding, VelocityField
from sb3_policyflow.kernels.compiler import kernels, note_fallback
from sb3_policyflow.kernels.networks import (
    Layer,
    Perceptron,
    Reader,
    Reading,
    addresses,
    are_as_read,
    in_memory,
    is_eager,
)
from sb3_policyflow.kernels.perceptron import (
    FirstLayer,
    Pass,
    any_needs_grad,
    differentiable_gradients,
    split_like,
)

Array = NDArray[Any]
N_EMBEDDING = 7
"""Tensors of the embeddings: frequencies, and the parameters of three layers."""


class FieldParts:
    """What a velocity field consists of, and all tensors that it depends on.

    :param frequencies: Those of the time embedding.
    :param time: The time embedding's two layers.
    :param observation: The observation embedding.
    :param network: The rest.
    """

    def __init__(
        self, frequencies: th.Tensor, time: Perceptron, observation: Layer, network: Perceptron
    ) -> None:
        self.time = time
        self.network = network
        self.dim = network.n_outputs
        self.features_dim = observation.weight.shape[1]
        self.tensors = [frequencies, *time.parameters, *observation, *network.parameters]
        self.shapes = [tensor.shape for tensor in self.tensors]

    def plain(
        self,
        times: th.Tensor,
        leading: th.Size,
        points: th.Tensor,
        features: th.Tensor,
        tensors: Sequence[th.Tensor],
    ) -> th.Tensor:
        """Velocities in plain torch, for derivatives of derivatives.

        :param times: Of a shape that broadcasts with the leading shape.
        :param leading: The shape that the n points have without their dimensions.
        :param points: shape (n, dim).
        :param features: shape (m, features_dim), where m divides n.
        :param tensors: In place of the field's own.
        """
        phases = 2 * math.pi * times.unsqueeze(-1) * tensors[0]
        time = self.time.plain(th.cat([phases.cos(), phases.sin()], dim=-1), tensors[1:5])
        observation = nn.functional.linear(features, *tensors[5:N_EMBEDDING])
        embedding = time.expand(*leading, -1).reshape(len(points), -1)
        embedding = embedding + observation.repeat_interleave(len(points) // len(features), dim=0)
        return self.network.plain(th.cat([points, embedding], dim=-1), tensors[N_EMBEDDING:])

    def serve(self, points: th.Tensor, features: th.Tensor) -> bool:
        """Whether points and features are those of kernels, and of this field."""
        dims = points.shape[-1], features.shape[-1]
        is_known = dims == (self.dim, self.features_dim) and points.numel() > 0
        return is_known and in_memory((points, features))


def read_field(reader: Reader, field: VelocityField) -> FieldParts | None:
    """The parts of a field, or None if it is not of the kind that kernels know."""
    embedding = reader.child(field, "time_embedding")
    hidden = reader.child(field, "hidden")
    if type(embedding) is FourierTimeEmbedding and isinstance(hidden, nn.Sequential):
        mlp = reader.child(embedding, "mlp")
        time = reader.perceptron(reader.children(mlp))
        observation = reader.layer(reader.child(field, "observation_embedding"))
        network = reader.perceptron((*reader.children(hidden), reader.child(field, "output")))
        is_plain = reader.are_plain(field, hidden, embedding, mlp)
        if time and observation and network and is_plain:
            frequencies = reader.buffer(embedding, "frequencies")
            return FieldParts(frequencies, time, observation, network)
    note_fallback(f"{type(field).__name__} has layers, activations or hooks of another kind")
    return None


class FusedVelocityField(VelocityField):
    """A :class:`VelocityField` that kernels evaluate where they can."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._reading = Reading(read_field)

    def parts(self) -> FieldParts | None:
        """What the field consists of, or None if kernels cannot work on it."""
        if not is_eager() or kernels() is None:
            return None
        parts = self._reading.of(self)
        if parts is None:
            return None
        if not are_as_read(parts.tensors, parts.shapes):
            note_fallback("parameters are not contiguous float32 on the CPU")
            return None
        return parts

    def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
        parts = self.parts()
        if parts is None:
            return super().forward(points, times, features)
        # Parts of tensors, such as the starts of a chain's steps, are worth a copy.
        points, times, features = points.contiguous(), times.contiguous(), features.contiguous()
        if not parts.serve(points, features) or not _is_data(times):
            note_fallback("a field is asked for what is not its own, or not float32 on the CPU")
            return super().forward(points, times, features)
        leading = points.shape[:-1]
        if features.shape[:-1] not in (leading, (*leading[:-1], 1)):
            features = features.expand(*leading, -1)
        flat = (points.reshape(-1, parts.dim), features.reshape(-1, parts.features_dim))
        velocity: th.Tensor
        if th.is_grad_enabled() and any_needs_grad((points, features, *parts.tensors)):
            apply: Any = _FieldEvaluation.apply
            velocity = apply(parts, times, leading, *flat, *parts.tensors)
        else:
            velocity, _ = _pass(parts, times, leading, *flat)[1].forth(keeps=False)
        return velocity.view_as(points)


def _is_data(times: th.Tensor) -> bool:
    return in_memory((times,)) and not times.requires_grad


class _Embedding:
    """What time and observation contribute to a field's first layer, and the way back.

    :param parts: The field.
    :param times: shape (n_times,).
    :param features: shape (m, features_dim).
    """

    def __init__(self, parts: FieldParts, times: Array, features: Array) -> None:
        self._dim = parts.dim
        self._times, self._features = times.reshape(-1).copy(), features
        frequencies, width, size = parts.tensors[0], parts.network.widths[0], parts.time.n_outputs
        self._n_frequencies = len(frequencies)
        n_times = self._times.size
        self._kept = np.empty((3, n_times, size), dtype=np.float32)
        table = np.empty((n_times, width), dtype=np.float32)
        self.index = np.empty(n_times, dtype=np.int64)
        self.shifts = np.empty((len(features), width), dtype=np.float32)
        module: Any = kernels()
        n_distinct = module.embed(
            self._times,
            self.index,
            self._n_frequencies,
            features,
            addresses(parts.tensors[: N_EMBEDDING + 2]),
            self._dim,
            *parts.time.activation,
            self._kept,
            table,
            self.shifts,
        )
        self._times, self.table = self._times[:n_distinct], table[:n_distinct]

    def back(
        self,
        tensors: Sequence[th.Tensor],
        grad_points: Array,
        grad_table: Array,
        grad_shifts: Array,
        grad_features: Array,
    ) -> th.Tensor:
        """Gradients of the parameters up to the first layer, one behind the other.

        :param tensors: Those of the field.
        :param grad_points: Of W^T, shape (dim, width).
        :param grad_table: Like the table.
        :param grad_shifts: Like the shifts.
        :param grad_features: Filled; shape (m, features_dim), or empty if it is not wanted.
        """
        tensors = tensors[: N_EMBEDDING + 2]
        grads = th.empty(sum(tensor.numel() for tensor in tensors[1:]))
        module: Any = kernels()
        module.embed_backward(
            self._times,
            self._n_frequencies,
            self._features,
            addresses(tensors),
            self._dim,
            self._kept,
            grad_points,
            grad_table,
            grad_shifts,
            grads.numpy(),
            grad_features,
        )
        return grads


def _pass(
    parts: FieldParts,
    times: th.Tensor,
    leading: th.Size,
    points: th.Tensor,
    features: th.Tensor,
) -> tuple[_Embedding, Pass]:
    embedding = _Embedding(parts, times.numpy(), features.detach().numpy())
    index = np.broadcast_to(embedding.index.reshape(times.shape), leading).reshape(-1)
    stride = parts.tensors[N_EMBEDDING].shape[1]
    first = FirstLayer(points.detach().numpy(), stride, embedding.table, index, embedding.shifts)
    return embedding, Pass(parts.network, first)


class _FieldEvaluation(th.autograd.Function):
    """A velocity field as a node of autograd's graph."""

    @staticmethod
    def forward(
        ctx: Any,
        parts: FieldParts,
        times: th.Tensor,
        leading: th.Size,
        points: th.Tensor,
        features: th.Tensor,
        *tensors: th.Tensor,
    ) -> th.Tensor:
        ctx.arguments = parts, times, leading
        ctx.embedding, ctx.way = _pass(parts, times, leading, points, features)
        outputs: th.Tensor
        outputs, kept = ctx.way.forth(keeps=True)
        ctx.save_for_backward(kept, points, features, *tensors)
        return outputs

    @staticmethod
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        kept, points, features, *tensors = ctx.saved_tensors
        if th.is_grad_enabled():
            parts, times, leading = ctx.arguments
            outputs = parts.plain(times, leading, points, features, tensors)
            grads = differentiable_gradients(outputs, ctx.saved_tensors[1:], grad_outputs)
            return None, None, None, *grads
        needs_points, needs_features = ctx.needs_input_grad[3:5]
        grad_points = th.empty_like(points if needs_points else points[:0])
        grad_features = th.empty_like(features if needs_features else features[:0])
        embedding = ctx.embedding
        flat, grad_shifts = ctx.way.back(
            kept, tensors[N_EMBEDDING:], grad_outputs, grad_points.numpy()
        )
        dim, (n_times, width) = points.shape[1], embedding.table.shape
        first = flat[: (dim + n_times) * width].view(-1, width).numpy()
        up_to_first = embedding.back(
            tensors, first[:dim], first[dim:], grad_shifts, grad_features.numpy()
        )
        others = flat[(dim + n_times) * width :]
        return (
            None,
            None,
            None,
            grad_points if needs_points else None,
            grad_features if needs_features else None,
            None,
            *split_like(up_to_first, tensors[1 : N_EMBEDDING + 2]),
            *split_like(others, tensors[N_EMBEDDING + 2 :]),
        )
