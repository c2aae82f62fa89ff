"""Velocity fields evaluated, differentiated and integrated by kernels."""

from functools import partial
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_policyflow.flows import VelocityField
from sb3_policyflow.kernels.compiler import note_fallback
from sb3_policyflow.kernels.field_parts import FieldParts, read_field
from sb3_policyflow.kernels.flow import FlowPlan, FlowPlans
from sb3_policyflow.kernels.graphs import FlowGraphs
from sb3_policyflow.kernels.inspection import KernelView, are_usable
from sb3_policyflow.kernels.layouts import FirstLayer, Floats, KernelInput
from sb3_policyflow.kernels.mlp import (
    Evaluation,
    any_needs_grad,
    differentiable_gradients,
    views_like,
)


class KernelVelocityField(VelocityField, has_formula_of_paper=True):
    """A :class:`VelocityField` that kernels evaluate and integrate where they can."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._view, self._view_on_gpu = KernelView(read_field), KernelView(read_field, "cuda")
        self._plans = FlowPlans()
        self._graphs = FlowGraphs()

    def parts(self, device: str = "cpu") -> FieldParts | str:
        """What the field consists of now, or the reason why it cannot be read.

        :param device: "cpu", where kernels work on it, or "cuda", where graphs have it.
        """
        view = self._view if device == "cpu" else self._view_on_gpu
        return view.of(self)

    def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
        parts = self.parts()
        if isinstance(parts, str):
            return super().forward(points, times, features)
        # Parts of tensors, such as the starts of a chain's steps, are worth a copy.
        points, times, features = points.contiguous(), times.contiguous(), features.contiguous()
        is_constant = are_usable((times,)) and not times.requires_grad
        if not parts.supports(points, features) or not is_constant:
            note_fallback("a field is asked for what is not its own, or not float32 on the CPU")
            return super().forward(points, times, features)
        leading = points.shape[:-1]
        if features.shape[:-1] not in (leading, (*leading[:-1], 1)):
            features = features.expand(*leading, -1).contiguous()
        if th.is_grad_enabled() and any_needs_grad((points, features, *parts.parameters)):
            apply: Any = _FieldEvaluation.apply
            velocity: th.Tensor = apply(self, parts, times, points, features, *parts.parameters)
            return velocity
        _, evaluation = _evaluation(parts, times, points, features)
        return evaluation.forward(saves=False)[0].view_as(points)

    def integrate(
        self,
        latents: th.Tensor,
        features: th.Tensor,
        *,
        solver: str,
        n_steps: int,
        end_time: float = 1.0,
    ) -> th.Tensor:
        if latents.shape[:-1] == features.shape[:-1]:
            plan = self._plan(latents, features, solver, n_steps, end_time)
            if plan is not None:
                return plan.transport(latents, features)
        carry = partial(super().integrate, solver=solver, n_steps=n_steps, end_time=end_time)
        endpoints = None
        if latents.is_cuda and self.has_formula_of_paper and not th.is_grad_enabled():
            parts, method = self.parts("cuda"), (solver, n_steps, end_time)
            if not isinstance(parts, str):
                endpoints = self._graphs.run(parts, carry, latents, features, method)
        return carry(latents, features) if endpoints is None else endpoints

    def choose_latents(
        self,
        candidates: th.Tensor,
        features: th.Tensor,
        *,
        solver: str,
        n_steps: int,
        end_time: float = 1.0,
    ) -> tuple[th.Tensor, th.Tensor]:
        plan = None
        if type(self).integrate is KernelVelocityField.integrate:
            plan = self._plan(candidates, features, solver, n_steps, end_time)
        if plan is not None:
            return plan.choose_latents(candidates, features)
        return super().choose_latents(
            candidates, features, solver=solver, n_steps=n_steps, end_time=end_time
        )

    def _plan(
        self,
        latents: th.Tensor,
        features: th.Tensor,
        solver: str,
        n_steps: int,
        end_time: float,
    ) -> FlowPlan | None:
        """What the kernel for flows takes; None where it cannot work."""
        are_matrices = latents.dim() == 2 and features.dim() == 2
        if self.has_formula_of_paper and are_matrices and not th.is_grad_enabled():
            parts = self.parts()
            if not isinstance(parts, str) and parts.supports(latents, features):
                return self._plans.get(parts, solver, n_steps, end_time)
        return None


class Embedding:
    """A field up to its first layer, forward and backward.

    :param parts: The field.
    :param times: shape (...).
    """

    def __init__(self, parts: FieldParts, times: Floats) -> None:
        self._parts = parts
        distinct = times.reshape(-1).copy()
        n_times, size, width = times.size, parts.time.n_outputs, parts.network.widths[0]
        self._first = FirstLayer(
            np.empty((parts.dim + parts.features_dim, width), dtype=np.float32),
            np.empty((n_times, width), dtype=np.float32),
            np.empty(n_times, dtype=np.int64),
            np.empty((n_times, parts.time.n_inputs), dtype=np.float32),
            *np.empty((3, n_times, size), dtype=np.float32),
        )
        n_distinct = parts.kernels.embed(distinct, parts.layout, self._first)
        self.times = distinct[:n_distinct]
        """The distinct times, shape (n_distinct,)."""

    def kernel_input(
        self, points: Floats, features: Floats, times_shape: th.Size, leading: th.Size
    ) -> KernelInput:
        """The first layer of the field's network.

        :param points: shape (n, dim).
        :param features: shape (m, features_dim).
        :param times_shape: The shape that the times have.
        :param leading: The shape that the n points have, with which it broadcasts.
        """
        weights, table, entries = self._first[:3]
        if times_shape != leading:
            # A copy: numba would compile the kernels again for a view that is not contiguous.
            entries = np.broadcast_to(entries.reshape(times_shape), leading).flatten()
        return KernelInput(points, features, weights, table[: len(self.times)], entries)

    def backward(self, grad_first: Floats, grads: Floats) -> None:
        """Gradients of the parameters up to the first layer.

        :param grad_first: Those of the first layer's weights and table, flat.
        :param grads: Filled with those of the ``embedding`` of the parts, flat.
        """
        self._parts.kernels.embed_backward(self._parts.layout, self._first, grad_first, grads)


def _evaluation(
    parts: FieldParts, times: th.Tensor, points: th.Tensor, features: th.Tensor
) -> tuple[Embedding, Evaluation]:
    flat_points = points.detach().view(-1, parts.dim).numpy()
    flat_features = features.detach().view(-1, parts.features_dim).numpy()
    embedding = Embedding(parts, times.numpy())
    leading = points.shape[:-1]
    first = embedding.kernel_input(flat_points, flat_features, times.shape, leading)
    return embedding, Evaluation(parts.network, first)


class _FieldEvaluation(th.autograd.Function):
    """A velocity field as a node of autograd's graph."""

    @staticmethod
    def forward(
        ctx: Any,
        field: VelocityField,
        parts: FieldParts,
        times: th.Tensor,
        points: th.Tensor,
        features: th.Tensor,
        *parameters: th.Tensor,
    ) -> th.Tensor:
        ctx.field, ctx.parts, ctx.times = field, parts, times
        ctx.embedding, ctx.evaluation = _evaluation(parts, times, points, features)
        outputs: th.Tensor
        outputs, saved = ctx.evaluation.forward(saves=True)
        # The frequencies, too, must not change before the backward pass.
        ctx.save_for_backward(saved, points, features, parts.frequencies, *parameters)
        return outputs.view_as(points)

    @staticmethod
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        saved, points, features, frequencies, *parameters = ctx.saved_tensors
        if th.is_grad_enabled():
            reference = _Reference(ctx.field, ctx.times)
            grads = differentiable_gradients(
                reference, [points, features], [frequencies, *parameters], grad_outputs
            )
            return None, None, None, *grads[:2], *grads[3:]
        needs_points, needs_features = ctx.needs_input_grad[3:5]
        grad_points = th.empty_like(points if needs_points else points[:0])
        grad_features = th.empty_like(features if needs_features else features[:0])
        n_embedding, parts = len(ctx.parts.embedding), ctx.parts
        of_first, others = ctx.evaluation.backward(
            saved,
            parameters[n_embedding - 2 :],
            grad_outputs.reshape(-1, parts.dim),
            grad_points.view(-1, parts.dim).numpy(),
            grad_features.view(-1, parts.features_dim).numpy(),
        )
        of_embedding = th.empty(parts.n_embedding, dtype=th.float32, device="cpu")
        ctx.embedding.backward(of_first.numpy(), of_embedding.numpy())
        return (
            None,
            None,
            None,
            grad_points if needs_points else None,
            grad_features if needs_features else None,
            *views_like(parts.embedding, of_embedding),
            *others,
        )


class _Reference(nn.Module):
    """A field in plain torch, for derivatives of derivatives.

    :param field: The field.
    :param times: The times that it is evaluated at.
    """

    def __init__(self, field: VelocityField, times: th.Tensor) -> None:
        super().__init__()
        self.field = field
        self._times = times

    def forward(self, points: th.Tensor, features: th.Tensor) -> th.Tensor:
        return VelocityField.forward(self.field, points, self._times, features)
