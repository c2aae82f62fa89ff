"""Networks evaluated and differentiated by kernels."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch.autograd.function import once_differentiable

from sb3_policyflow.fused.compiler import kernels
from sb3_policyflow.fused.networks import Activation, Perceptron, in_memory
from sb3_policyflow.fused.threads import in_parts, n_parts


class FirstLayer(NamedTuple):
    """A first layer of h outputs: inputs @ weight.T + table[index] + shifts.

    Inputs (n, n_inputs), weight (h, n_inputs), table (n_entries, h), index (n,), and shifts (m, h)
    of which each serves n / m rows; m may be 0.
    """

    inputs: th.Tensor
    weight: th.Tensor
    table: th.Tensor
    index: th.Tensor
    shifts: th.Tensor


class Gradients(NamedTuple):
    """Gradients with respect to a first layer, without its index, and to the layers behind it."""

    inputs: th.Tensor | None
    weight: th.Tensor
    table: th.Tensor
    shifts: th.Tensor
    others: list[th.Tensor]


class Pass:
    """One evaluation of a network, and the way back.

    :param activation: The network's activation.
    :param first: Its first layer, evaluated.
    :param others: Weight and bias of each layer behind it.
    :param keeps: Whether to keep what the way back needs.
    """

    def __init__(
        self, activation: Activation, first: FirstLayer, others: list[th.Tensor], keeps: bool
    ) -> None:
        self._weight = first.weight.T.contiguous()
        weights = others[::2]
        self._widths = np.array([weight.shape[1] for weight in weights])
        n_rows, n_kept = len(first.inputs), int(self._widths.sum())
        work = self._weight.numel() + sum(weight.numel() for weight in weights)
        self._parts = n_parts(n_rows, work)
        self.kept = first.inputs.new_empty(2, n_rows * n_kept if keeps else 0)
        self.outputs = first.inputs.new_empty(n_rows, len(others[-1]))
        module: Any = kernels()
        arguments = (
            first.inputs.numpy(),
            self._weight.numpy(),
            first.table.numpy(),
            first.index.numpy(),
            first.shifts.numpy(),
            _addresses(others),
            self._widths,
            others[-2].numpy(),
            others[-1].numpy(),
            getattr(module, activation.name),
            activation.alpha,
            self.outputs.numpy(),
            *self.kept.numpy(),
        )
        run = module.forward
        in_parts(n_rows, self._parts, lambda _, start, stop: run(*arguments, start, stop))

    def back(
        self,
        first: FirstLayer,
        others: list[th.Tensor],
        grad_outputs: th.Tensor,
        needs_inputs: bool = False,
    ) -> Gradients:
        """The gradients of what has these gradients with respect to the outputs.

        :param first: The first layer again.
        :param others: The layers behind it again.
        :param grad_outputs: Shape (n, n_outputs).
        :param needs_inputs: Whether gradients with respect to the inputs are wanted.
        """
        inputs, shifts = first.inputs, first.shifts
        tensors = (self._weight, first.table, *others)
        sizes = [tensor.numel() for tensor in tensors]
        grads = inputs.new_zeros(self._parts, sum(sizes))
        grad_shifts = th.zeros_like(shifts)
        grad_inputs = th.empty_like(inputs if needs_inputs else inputs[:0])
        before = (
            inputs.numpy(),
            self._weight.numpy(),
            first.index.numpy(),
            _addresses(others),
            self._widths,
            others[-2].numpy(),
            *self.kept.numpy(),
            grad_outputs.contiguous().numpy(),
        )
        after = (len(first.table), grad_shifts.numpy(), grad_inputs.numpy())
        group = len(inputs) // len(shifts) if len(shifts) else 1
        flat, run = grads.numpy(), kernels().backward  # type: ignore[union-attr]
        in_parts(
            len(inputs) // group,
            self._parts,
            lambda part, start, stop: run(*before, flat[part], *after, start * group, stop * group),
        )
        total = grads[0] if self._parts == 1 else grads.sum(0)
        weight, table, *rest = (
            grad.view_as(tensor) for grad, tensor in zip(total.split(sizes), tensors, strict=True)
        )
        return Gradients(grad_inputs if needs_inputs else None, weight.T, table, grad_shifts, rest)


def _addresses(others: list[th.Tensor]) -> Any:
    """Where the parameters are of the layers between the first and the output."""
    return np.array([tensor.data_ptr() for tensor in others[:-2]], dtype=np.int64)


class _PerceptronEvaluation(th.autograd.Function):
    """A perceptron as a node of autograd's graph."""

    @staticmethod
    def forward(
        ctx: Any, activation: Activation, inputs: th.Tensor, *parameters: th.Tensor
    ) -> th.Tensor:
        keeps = any(ctx.needs_input_grad)
        ctx.way = Pass(
            activation, _own_first_layer(inputs, parameters), list(parameters[2:]), keeps
        )
        if keeps:
            ctx.save_for_backward(inputs, *parameters)
        outputs: th.Tensor = ctx.way.outputs
        return outputs

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        inputs, *parameters = ctx.saved_tensors
        first = _own_first_layer(inputs, parameters)
        grads = ctx.way.back(first, parameters[2:], grad_outputs, ctx.needs_input_grad[1])
        return (
            None,
            grads.inputs,
            grads.weight.contiguous(),
            grads.table.view(-1),
            *grads.others,
        )


def _own_first_layer(inputs: th.Tensor, parameters: Any) -> FirstLayer:
    weight, bias = parameters[:2]
    index = inputs.new_zeros(len(inputs), dtype=th.int64)
    return FirstLayer(inputs, weight, bias.view(1, -1), index, bias.new_empty(0, len(bias)))


def evaluate_perceptron(network: Perceptron, inputs: th.Tensor) -> th.Tensor | None:
    """Outputs (n, n_outputs) for inputs (n, n_inputs), or None where kernels cannot work."""
    parameters = [tensor for layer in network.layers for tensor in layer]
    if kernels() is None or inputs.dim() != 2 or not in_memory((inputs, *parameters)):
        return None
    outputs: th.Tensor = _PerceptronEvaluation.apply(network.activation, inputs, *parameters)
    return outputs
