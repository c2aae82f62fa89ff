"""MLPs evaluated and differentiated by kernels."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_policyflow.kernels.activations import Activation
from sb3_policyflow.kernels.compiler import note_fallback
from sb3_policyflow.kernels.inspection import (
    Layer,
    ModuleInspector,
    UnsupportedError,
    addresses,
    are_usable,
)
from sb3_policyflow.kernels.layouts import (
    Floats,
    Integers,
    KernelInput,
    Kernels,
    MLPGradients,
    MLPLayout,
)
from sb3_policyflow.kernels.threads import in_parts, n_parts

NO_INDEX: Integers = np.zeros(0, dtype=np.int64)
NO_POINTS: Floats = np.zeros((0, 0), dtype=np.float32)


class MLP:
    """Linear layers, at least two, with one activation between them, as they are when it is made.

    Weights may change, and are read where they are; the place does not change. ``held`` are the
    parameters as they were, without gradient: they keep that place, which another thread may take
    from the parameters by setting their ``data``.

    :param kernels: The kernels.
    :param modules: The layers and activations.
    :param layers: The layers' parameters.
    :param activation: The activation.
    :raises UnsupportedError: If the shapes of the layers do not fit each other.
    """

    def __init__(
        self,
        kernels: Kernels,
        modules: list[nn.Module],
        layers: list[Layer],
        activation: Activation,
    ) -> None:
        self.kernels = kernels
        self.modules = modules
        self.layers = layers
        self.activation_layout = kernels.activation_address(activation.kind), activation.alpha
        self.tensors = [tensor for layer in layers for tensor in layer]
        self.held = [tensor.detach() for tensor in self.tensors]
        self.n_parameters = sum(tensor.numel() for tensor in self.held)
        self.shapes = [tensor.shape for tensor in self.held]
        self.places = [tensor.data_ptr() for tensor in self.held]
        weights, biases = self.held[::2], self.held[1::2]
        self.n_inputs = weights[0].shape[1]
        widths = [bias.numel() for bias in biases]
        sizes = zip(widths, [self.n_inputs, *widths], strict=False)
        if [tuple(weight.shape) for weight in weights] != list(sizes):
            raise UnsupportedError("the shapes of a network's layers do not fit each other")
        self.n_outputs = widths.pop()
        self.n_hidden = sum(widths)
        self.widths: Integers = np.array(widths)
        self.flops_per_row = sum(weight.numel() for weight in weights)
        self.layout = self.layout_of(self.held)

    def layout_of(self, parameters: Sequence[th.Tensor]) -> MLPLayout:
        """Where an MLP of these shapes is in memory.

        :param parameters: Weight and bias of each layer.
        """
        places = addresses(parameters)
        return MLPLayout(places[::2], places[1::2], self.widths, *self.activation_layout)


def read_mlp(kernels: Kernels, inspector: ModuleInspector, modules: Iterable[nn.Module]) -> MLP:
    """Read linear layers and the activations between them.

    >>> from sb3_policyflow.kernels.compiler import load_kernels
    >>> modules = [nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1)]
    >>> read_mlp(load_kernels(), ModuleInspector(), modules).widths
    array([3])

    :raises UnsupportedError: If the modules are anything else.
    """
    modules = list(modules)
    if len(modules) < 3:
        raise UnsupportedError("a network has no hidden layers")
    layers = [inspector.layer(module) for module in modules[::2]]
    activations = {inspector.activation(module) for module in modules[1::2]}
    if len(activations) > 1 or len(modules) % 2 == 0:
        raise UnsupportedError("a network is not linear layers with one activation between them")
    return MLP(kernels, modules, layers, activations.pop())


class Evaluation:
    """An evaluation of an MLP, forward and backward.

    It holds on to neither outputs nor what is saved for the backward pass: they belong to autograd,
    which knows when they are no longer needed.

    :param network: The MLP, of which the first layer's bias is not used.
    :param first: Its first layer.
    """

    def __init__(self, network: MLP, first: KernelInput) -> None:
        self._network, self._first = network, first
        self._n_parts = n_parts(len(first.points), network.flops_per_row)

    def forward(self, saves: bool) -> tuple[th.Tensor, th.Tensor]:
        """Evaluate.

        :param saves: Whether there may be a backward pass.
        :return: The outputs, shape (n, n_outputs), and what the backward pass needs.
        """
        network, first, n_rows = self._network, self._first, len(self._first.points)
        outputs = th.empty(n_rows, network.n_outputs, dtype=th.float32, device="cpu")
        # NumPy asks for huge pages. PyTorch does not, and FPO's updates spent a third of their time
        # waiting for small ones.
        n_saved = n_rows * network.n_hidden if saves else 0
        saved = th.from_numpy(np.empty((2, n_saved), dtype=np.float32))
        layout, (values, derivatives) = network.layout, saved.numpy()
        run, filled = network.kernels.forward, outputs.numpy()
        self._in_parts(
            lambda _, start, stop: run(first, layout, filled, values, derivatives, start, stop)
        )
        return outputs, saved

    def backward(
        self,
        saved: th.Tensor,
        parameters: Sequence[th.Tensor],
        grad_outputs: th.Tensor,
        grad_points: Floats,
        grad_features: Floats,
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """Differentiate.

        :param saved: What :meth:`forward` saved.
        :param parameters: Those of the MLP again.
        :param grad_outputs: The gradient of the outputs, shape (n, n_outputs).
        :param grad_points: Filled; shape (n, n_points), or empty if it is not wanted.
        :param grad_features: Filled; shape (m, n_features), or empty if it is not wanted.
        :return: Gradients of the first layer's weights and table, flat, and of other parameters.
        """
        network, first = self._network, self._first
        n_first = first.weights.size + first.table.size
        n_others = sum(parameter.numel() for parameter in parameters[2:])
        # Each thread adds up its own.
        flat = th.zeros(self._n_parts, n_first + n_others, dtype=th.float32, device="cpu")
        of_thread = flat.numpy()
        layout, (values, derivatives) = network.layout_of(parameters), saved.numpy()
        outputs, run = grad_outputs.contiguous().numpy(), network.kernels.backward

        def run_part(part: int, start: int, stop: int) -> None:
            of_first, of_others = of_thread[part, :n_first], of_thread[part, n_first:]
            gradients = MLPGradients(of_first, of_others, grad_points, grad_features)
            run(first, layout, values, derivatives, outputs, gradients, start, stop)

        self._in_parts(run_part)
        total = flat[0] if self._n_parts == 1 else flat.sum(0)
        return total[:n_first], views_like(parameters[2:], total[n_first:])

    def _in_parts(self, run: Callable[[int, int, int], None]) -> None:
        """Call ``run(part, start, stop)`` for parts of the rows, the same parts on both passes.

        What is saved depends on where blocks of rows begin, and rows of a sample belong together.
        """
        n_samples = len(self._first.features)
        group = len(self._first.points) // n_samples
        in_parts(
            n_samples,
            self._n_parts,
            lambda part, start, stop: run(part, start * group, stop * group),
        )


def views_like(tensors: Sequence[th.Tensor], flat: th.Tensor) -> list[th.Tensor]:
    """Views of a tensor, one behind the other, with the shapes of others.

    >>> [view.shape for view in views_like([th.ones(2, 3), th.ones(4)], th.arange(10))]
    [torch.Size([2, 3]), torch.Size([4])]
    """
    return list(th._C._nn.unflatten_dense_tensors(flat, list(tensors)))


class _MLPEvaluation(th.autograd.Function):
    """An MLP as a node of autograd's graph."""

    @staticmethod
    def forward(ctx: Any, network: MLP, inputs: th.Tensor, *parameters: th.Tensor) -> th.Tensor:
        ctx.network, ctx.evaluation = network, _evaluation(network, inputs)
        outputs: th.Tensor
        outputs, saved = ctx.evaluation.forward(saves=True)
        ctx.save_for_backward(saved, inputs, *parameters)
        return outputs

    @staticmethod
    def backward(ctx: Any, grad_outputs: th.Tensor) -> Any:
        saved, inputs, *parameters = ctx.saved_tensors
        if th.is_grad_enabled():
            module = nn.Sequential(*ctx.network.modules)
            return None, *differentiable_gradients(module, [inputs], parameters, grad_outputs)
        grad_inputs = th.empty_like(inputs if ctx.needs_input_grad[1] else inputs[:0])
        of_first, others = ctx.evaluation.backward(
            saved, parameters, grad_outputs, NO_POINTS, grad_inputs.numpy()
        )
        weight, bias = parameters[:2]
        return (
            None,
            grad_inputs if ctx.needs_input_grad[1] else None,
            of_first[: weight.numel()].view(weight.T.shape).T.contiguous(),
            of_first[weight.numel() :].view_as(bias),
            *others,
        )


def mlp_input(network: MLP, features: Floats) -> KernelInput:
    """An MLP's first layer as kernels take it: inputs are features, and there are no points."""
    weight, bias = network.held[0].numpy(), network.held[1].numpy()
    no_points = np.empty((len(features), 0), dtype=np.float32)
    return KernelInput(no_points, features, np.ascontiguousarray(weight.T), bias[None], NO_INDEX)


def _evaluation(network: MLP, inputs: th.Tensor) -> Evaluation:
    return Evaluation(network, mlp_input(network, inputs.detach().numpy()))


def differentiable_gradients(
    module: nn.Module,
    inputs: Sequence[th.Tensor],
    parameters: Sequence[th.Tensor],
    grad_outputs: th.Tensor,
) -> list[th.Tensor | None]:
    """Gradients that have gradients themselves, in plain torch.

    :param module: What was evaluated.
    :param inputs: What it was called with.
    :param parameters: Its parameters then, in the order of ``named_parameters``.
    :param grad_outputs: The gradient of the outputs.
    :return: A gradient, or None, for each input and each parameter.
    """
    names = [name for name, _ in module.named_parameters(remove_duplicate=False)]
    outputs = th.func.functional_call(
        module, dict(zip(names, parameters, strict=True)), tuple(inputs)
    )
    tensors = [*inputs, *parameters]
    needed = [tensor for tensor in tensors if tensor.requires_grad]
    found = iter(th.autograd.grad(outputs, needed, grad_outputs, create_graph=True))
    return [next(found) if tensor.requires_grad else None for tensor in tensors]


def any_needs_grad(tensors: Iterable[th.Tensor]) -> bool:
    """Whether a gradient with respect to any of the tensors may be asked for."""
    return any(tensor.requires_grad for tensor in tensors)


def evaluate_mlp(network: MLP, inputs: th.Tensor) -> th.Tensor | None:
    """Evaluate an MLP.

    :param network: The MLP, as it is now.
    :param inputs: shape (n, n_inputs).
    :return: The outputs, shape (n, n_outputs), or None where kernels cannot work on the inputs.
    """
    if inputs.dim() != 2 or inputs.shape[1] != network.n_inputs:
        return None
    if not are_usable((inputs,)):
        note_fallback("features are not contiguous float32 on the CPU")
        return None
    if not (th.is_grad_enabled() and any_needs_grad((inputs, *network.tensors))):
        return _evaluation(network, inputs).forward(saves=False)[0]
    apply: Callable[..., th.Tensor] = _MLPEvaluation.apply
    return apply(network, inputs, *network.tensors)
