"""Networks evaluated and differentiated by kernels."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch as th

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


def evaluate(first: FirstLayer, network: Perceptron) -> th.Tensor:
    """Outputs (n, n_outputs) of a network whose first layer is given; differentiable."""
    others = [tensor for layer in network.layers[1:] for tensor in layer]
    outputs: th.Tensor = _Evaluation.apply(network.activation, *first, *others)
    return outputs


def evaluate_perceptron(network: Perceptron, inputs: th.Tensor) -> th.Tensor | None:
    """Outputs (n, n_outputs) for inputs (n, n_inputs), or None where kernels cannot work."""
    tensors = [tensor for layer in network.layers for tensor in layer]
    if kernels() is None or not in_memory((inputs, *tensors)):
        return None
    weight, bias = network.layers[0]
    index = th.zeros(len(inputs), dtype=th.int64)
    no_shifts = bias.new_empty(0, len(bias))
    return evaluate(FirstLayer(inputs, weight, bias.unsqueeze(0), index, no_shifts), network)


class _Evaluation(th.autograd.Function):
    """A network of kernels that keeps activations and their slopes for its gradient."""

    @staticmethod
    def forward(ctx: Any, activation: Activation, *tensors: th.Tensor) -> th.Tensor:  # type: ignore[override]
        first, others = FirstLayer(*tensors[:5]), tensors[5:]
        layout = _Layout(first, others)
        n_rows = len(first.inputs)
        outputs = first.inputs.new_empty(n_rows, layout.n_outputs)
        keeps = any(ctx.needs_input_grad)
        kept = first.inputs.new_empty(2, n_rows * layout.total if keeps else 0)
        transposed = first.weight.T.contiguous()
        arguments = (
            first.inputs.numpy(),
            transposed.numpy(),
            first.table.numpy(),
            first.index.numpy(),
            first.shifts.numpy(),
            layout.addresses,
            layout.widths,
            others[-2].numpy(),
            others[-1].numpy(),
            getattr(kernels(), activation.name),
            activation.alpha,
            outputs.numpy(),
            *kept.numpy(),
        )
        run = kernels().forward
        in_parts(n_rows, layout.parts, lambda _, start, stop: run(*arguments, start, stop))
        if keeps:
            ctx.save_for_backward(transposed, kept, *tensors)
        return outputs

    @staticmethod
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:  # type: ignore[override]
        transposed, kept, *tensors = ctx.saved_tensors
        first, others = FirstLayer(*tensors[:5]), tensors[5:]
        layout = _Layout(first, others)
        needs_inputs = ctx.needs_input_grad[1]
        sizes = [first.weight.numel(), first.table.numel(), *(t.numel() for t in others)]
        grads = first.inputs.new_zeros(layout.parts, sum(sizes))
        grad_shifts = th.zeros_like(first.shifts)
        grad_inputs = th.empty_like(first.inputs if needs_inputs else first.inputs[:0])
        before = (
            first.inputs.numpy(),
            transposed.numpy(),
            first.index.numpy(),
            layout.addresses,
            layout.widths,
            others[-2].numpy(),
            *kept.numpy(),
            grad_outputs.contiguous().numpy(),
        )
        flat = grads.numpy()
        after = (len(first.table), grad_shifts.numpy(), grad_inputs.numpy())
        run = kernels().backward
        group = layout.group
        in_parts(
            len(first.inputs) // group,
            layout.parts,
            lambda part, start, stop: run(*before, flat[part], *after, start * group, stop * group),
        )
        total = grads[0] if layout.parts == 1 else grads.sum(0)
        grad_weight, grad_table, *grad_others = total.split(sizes)
        return (
            None,
            grad_inputs if needs_inputs else None,
            grad_weight.view_as(transposed).T,
            grad_table.view_as(first.table),
            None,
            grad_shifts,
            *(grad.view_as(tensor) for grad, tensor in zip(grad_others, others, strict=True)),
        )


class _Layout:
    """Where the kernels find the layers, and what they cost."""

    def __init__(self, first: FirstLayer, others: Iterable[th.Tensor]) -> None:
        others = list(others)
        weights = others[::2]
        self.widths = np.array([weight.shape[1] for weight in weights])
        self.addresses = np.array([tensor.data_ptr() for tensor in others[:-2]], dtype=np.int64)
        self.n_outputs = len(others[-1])
        self.total = sum(weight.shape[1] for weight in weights)
        work = first.weight.numel() + sum(weight.numel() for weight in weights)
        self.parts = n_parts(len(first.inputs), work)
        self.group = len(first.inputs) // max(len(first.shifts), 1) if len(first.shifts) else 1
