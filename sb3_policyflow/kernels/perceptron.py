"""Networks evaluated and differentiated by kernels."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_policyflow.kernels.compiler import kernels, note_fallback
from sb3_policyflow.kernels.networks import Perceptron, addresses, are_as_read, in_memory
from sb3_policyflow.kernels.threads import in_parts, n_parts

Array = NDArray[Any]
NOWHERE: Array = np.zeros(0, dtype=np.int64)


class FirstLayer(NamedTuple):
    """A first layer of h outputs: inputs @ W^T + table[entries] + shifts.

    Inputs (n, n_inputs), the first of whose ``stride`` columns of weights W are used; table
    (n_entries, h); entries (n,), where an empty array stands for zeros; and shifts (m, h), of which
    each serves n / m rows; m may be 0.
    """

    inputs: Array
    stride: int
    table: Array
    entries: Array
    shifts: Array


class Pass:
    """An evaluation of a network, and the way back.

    It holds on to neither outputs nor what is kept for the way back: they belong to autograd, which
    knows when they are no longer needed.

    :param network: The network, of which the first layer's bias is not used.
    :param first: The first layer, evaluated.
    """

    def __init__(self, network: Perceptron, first: FirstLayer) -> None:
        self._network, self._first = network, first
        self._parts = n_parts(len(first.inputs), network.work)

    def forth(self, keeps: bool) -> tuple[th.Tensor, th.Tensor]:
        """The outputs, shape (n, n_outputs), and what the way back needs, if it is to be kept."""
        network, n_rows = self._network, len(self._first.inputs)
        outputs = th.empty(n_rows, network.n_outputs)
        # NumPy asks for huge pages. PyTorch does not, and FPO's updates spent a third of their time
        # waiting for small ones.
        n_kept = n_rows * network.n_hidden if keeps else 0
        kept = th.from_numpy(np.empty((2, n_kept), dtype=np.float32))
        arguments = (
            *self._first,
            addresses(network.parameters),
            network.widths,
            *network.activation,
            outputs.numpy(),
            *kept.numpy(),
        )
        module: Any = kernels()
        run = module.forward
        self._in_parts(lambda _, start, stop: run(*arguments, start, stop))
        return outputs, kept

    def _in_parts(self, run: Callable[[int, int, int], None]) -> None:
        """Call ``run(part, start, stop)`` for parts of the rows, the same parts on both ways.

        What is kept depends on where blocks of rows begin, and rows that share a shift belong
        together.
        """
        n_rows, n_shifts = len(self._first.inputs), len(self._first.shifts)
        group = n_rows // n_shifts if n_shifts else 1
        in_parts(
            n_rows // group,
            self._parts,
            lambda part, start, stop: run(part, start * group, stop * group),
        )

    def back(
        self,
        kept: th.Tensor,
        parameters: Sequence[th.Tensor],
        grad_outputs: th.Tensor,
        grad_inputs: Array,
    ) -> tuple[th.Tensor, Array]:
        """The gradients of what has these gradients with respect to the outputs.

        :param kept: What :meth:`forth` kept.
        :param parameters: Those of the network again.
        :param grad_outputs: Shape (n, n_outputs).
        :param grad_inputs: Filled; shape (n, n_inputs), or empty if it is not wanted.
        :return: Those of W^T, of the table, and of all parameters behind the first layer, one
            behind the other; and those of the shifts.
        """
        network, (inputs, stride, table, entries, shifts) = self._network, self._first
        n_grads = inputs.shape[1] * table.shape[1] + table.size
        n_grads += sum(tensor.numel() for tensor in parameters[2:])
        grads = th.zeros(self._parts, n_grads)
        grad_shifts = np.zeros_like(shifts)
        before = (
            inputs,
            stride,
            entries,
            addresses(parameters),
            network.widths,
            *kept.numpy(),
            grad_outputs.contiguous().numpy(),
        )
        after = (len(table), grad_shifts, grad_inputs)
        module: Any = kernels()
        flat, run = grads.numpy(), module.backward
        self._in_parts(lambda part, start, stop: run(*before, flat[part], *after, start, stop))
        return grads[0] if self._parts == 1 else grads.sum(0), grad_shifts


class _PerceptronEvaluation(th.autograd.Function):
    """A perceptron as a node of autograd's graph."""

    @staticmethod
    def forward(
        ctx: Any, network: Perceptron, inputs: th.Tensor, *parameters: th.Tensor
    ) -> th.Tensor:
        ctx.network, ctx.way = network, _pass(network, inputs)
        outputs: th.Tensor
        outputs, kept = ctx.way.forth(keeps=True)
        ctx.save_for_backward(kept, inputs, *parameters)
        return outputs

    @staticmethod
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        kept, inputs, *parameters = ctx.saved_tensors
        if th.is_grad_enabled():
            outputs = ctx.network.plain(inputs, parameters)
            return None, *differentiable_gradients(outputs, [inputs, *parameters], grad_outputs)
        grad_inputs = th.empty_like(inputs if ctx.needs_input_grad[1] else inputs[:0])
        flat, _ = ctx.way.back(kept, parameters, grad_outputs, grad_inputs.numpy())
        weight, *others = split_like(flat, parameters)
        weight = weight.view(inputs.shape[1], -1).T.contiguous()
        return None, grad_inputs if len(grad_inputs) else None, weight, *others


def _pass(network: Perceptron, inputs: th.Tensor) -> Pass:
    table = network.parameters[1].detach().numpy()[None]
    no_shifts = np.zeros((0, table.shape[1]), dtype=np.float32)
    first = FirstLayer(inputs.detach().numpy(), inputs.shape[1], table, NOWHERE, no_shifts)
    return Pass(network, first)


def differentiable_gradients(
    outputs: th.Tensor, inputs: Sequence[th.Tensor], grad_outputs: th.Tensor
) -> list[th.Tensor | None]:
    """Gradients that have gradients themselves; None for inputs that need none."""
    needed = [tensor for tensor in inputs if tensor.requires_grad]
    found = iter(th.autograd.grad(outputs, needed, grad_outputs, create_graph=True))
    return [next(found) if tensor.requires_grad else None for tensor in inputs]


def split_like(flat: th.Tensor, tensors: Sequence[th.Tensor]) -> list[th.Tensor]:
    """Parts of a tensor that have the shapes of others."""
    sizes = [tensor.numel() for tensor in tensors]
    parts = th.split(flat, sizes)
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def any_needs_grad(tensors: Iterable[th.Tensor]) -> bool:
    """Whether a gradient with respect to any of the tensors may be asked for."""
    return any(tensor.requires_grad for tensor in tensors)


def evaluate_perceptron(network: Perceptron, inputs: th.Tensor) -> th.Tensor | None:
    """Outputs (n, n_outputs) for inputs (n, n_inputs), or None where kernels cannot work."""
    if kernels() is None or inputs.dim() != 2 or inputs.shape[1] != network.n_inputs:
        return None
    if not (are_as_read(network.parameters, network.shapes) and in_memory((inputs,))):
        note_fallback("features or parameters are not contiguous float32 on the CPU")
        return None
    if not (th.is_grad_enabled() and any_needs_grad((inputs, *network.parameters))):
        return _pass(network, inputs).forth(keeps=False)[0]
    apply: Callable[..., th.Tensor] = _PerceptronEvaluation.apply
    return apply(network, inputs, *network.parameters)
