"""Reading networks: which of them the kernels know, and where their parameters are."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_policyflow.kernels.activations import PLAIN, WITH_ALPHA, Activation

T = TypeVar("T")


class Layer(NamedTuple):
    """The parameters of a linear layer: shapes (n_out, n_in) and (n_out,)."""

    weight: th.Tensor
    bias: th.Tensor


class Perceptron:
    """Linear layers, at least two, with one activation between them.

    :param layers: Their parameters.
    :param activation: The activation, for kernels.
    :param function: The activation, for torch.
    """

    def __init__(self, layers: list[Layer], activation: Activation, function: nn.Module) -> None:
        self.layers = layers
        self.activation = activation
        self.function = function
        self.parameters = [tensor for layer in layers for tensor in layer]
        self.shapes = [tensor.shape for tensor in self.parameters]
        self.n_inputs = layers[0].weight.shape[1]
        widths = [len(layer.bias) for layer in layers]
        self.n_outputs = widths.pop()
        self.n_hidden = sum(widths)
        self.widths: NDArray[np.int64] = np.array(widths)
        self.work = sum(layer.weight.numel() for layer in layers)

    def plain(self, inputs: th.Tensor, parameters: Sequence[th.Tensor]) -> th.Tensor:
        """The outputs in plain torch, for derivatives of derivatives.

        :param inputs: shape (..., n_inputs).
        :param parameters: Weight and bias of each layer.
        """
        *hidden, (weight, bias) = zip(parameters[::2], parameters[1::2], strict=True)
        for hidden_weight, hidden_bias in hidden:
            inputs = self.function(nn.functional.linear(inputs, hidden_weight, hidden_bias))
        return nn.functional.linear(inputs, weight, bias)


class Reader:
    """Reads parameters from modules, and remembers where from.

    Modules with hooks are refused: hooks are how pruning, weight normalization and those who watch
    activations take part.
    """

    def __init__(self) -> None:
        self._hooks: list[Any] = []
        self._places: list[tuple[Any, str, object]] = []

    def holds(self) -> bool:
        """Whether all that was read would be read again.

        It is asked at every call, so it is the shortest of loops over dictionaries.
        """
        if any(self._hooks):
            return False
        for place, name, thing in self._places:  # noqa: SIM110  # all() takes twice as long
            if place.get(name) is not thing:
                return False
        return True

    def is_plain(self, module: nn.Module) -> bool:
        """Whether a module does nothing beside its own computation."""
        hooks = (
            module._forward_hooks,
            module._forward_pre_hooks,
            module._backward_hooks,
            module._backward_pre_hooks,
        )
        self._hooks += hooks
        self._places.append((module.__dict__, "forward", None))
        return not any(hooks) and "forward" not in module.__dict__

    def are_plain(self, *modules: nn.Module) -> bool:
        """Whether :meth:`is_plain` holds for all of them."""
        return all(list(map(self.is_plain, modules)))

    def child(self, module: nn.Module, name: str) -> Any:
        """A module within a module."""
        child = module._modules[name]
        self._places.append((module._modules, name, child))
        return child

    def children(self, module: nn.Module) -> list[Any]:
        """All modules within a module."""
        return [self.child(module, name) for name in module._modules]

    def buffer(self, module: nn.Module, name: str) -> Any:
        """A tensor of a module that is not a parameter."""
        tensor = module._buffers[name]
        self._places.append((module._buffers, name, tensor))
        return tensor

    def layer(self, module: nn.Module) -> Layer | None:
        """The parameters of a module that is nothing but linear, or None."""
        if type(module) is not nn.Linear or not self.is_plain(module):
            return None
        parameters = module._parameters
        weight, bias = parameters.get("weight"), parameters.get("bias")
        if weight is None or bias is None:
            return None
        self._places += [(parameters, "weight", weight), (parameters, "bias", bias)]
        return Layer(weight, bias)

    def activation(self, module: nn.Module) -> Activation | None:
        """An activation as the kernels know it, or None.

        >>> Reader().activation(nn.ELU(0.5)), Reader().activation(nn.GELU())
        (Activation(kind=2, alpha=0.5), None)
        """
        if not self.is_plain(module):
            return None
        if type(module) not in WITH_ALPHA:
            return PLAIN.get(type(module))
        kind, name = WITH_ALPHA[type(module)]
        alpha = module.__dict__[name]
        self._places.append((module.__dict__, name, alpha))
        return Activation(kind, float(alpha))

    def perceptron(self, modules: Iterable[nn.Module]) -> Perceptron | None:
        """The network that the modules make up, or None if it is of another kind.

        >>> modules = [nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1)]
        >>> Reader().perceptron(modules).widths
        array([3])
        >>> Reader().perceptron([*modules, nn.Tanh()]) is None
        True
        """
        modules = list(modules)
        layers = [self.layer(module) for module in modules[::2]]
        known = [layer for layer in layers if layer is not None]
        activations = {self.activation(module) for module in modules[1::2]}
        if len(activations) != 1 or len(modules) % 2 == 0 or len(known) < len(layers):
            return None
        activation = activations.pop()
        return None if activation is None else Perceptron(known, activation, modules[1])


class Reading(Generic[T]):
    """What was read last from a module, read again when the module has changed.

    Values of parameters are not part of it; the tensors are.

    :param read: Reads, or says None if the kernels do not know the module's kind.
    """

    def __init__(self, read: Callable[[Reader, Any], T | None]) -> None:
        self._read = read
        self._reader = Reader()
        self._module: object = None
        self._found: T | None = None

    def __reduce__(self) -> Any:
        # A copy reads for itself.
        return type(self), (self._read,)

    def of(self, module: Any) -> T | None:
        """What there is to be read from the module."""
        if self._found is None or module is not self._module or not self._reader.holds():
            self._module, self._reader = module, Reader()
            self._found = self._read(self._reader, module)
        return self._found


def is_eager() -> bool:
    """Whether tensors have values, which they have not for those who compile, export or trace."""
    return not th.compiler.is_compiling() and th._C._get_tracing_state() is None


def in_memory(tensors: Iterable[th.Tensor]) -> bool:
    """Whether kernels can work on these tensors: contiguous float32 on the CPU."""
    for tensor in tensors:
        if tensor.dtype is not th.float32 or not tensor.is_cpu or not tensor.is_contiguous():
            return False
    # Within torch.func's transformations tensors stand for others, and autocast wants another type.
    is_transformed = th._C._functorch.peek_interpreter_stack() is not None
    return not (is_transformed or th.is_autocast_enabled("cpu"))


def are_as_read(tensors: Iterable[th.Tensor], shapes: Iterable[th.Size]) -> bool:
    """Whether kernels can work on the tensors of a module, which have the shapes they were read in.

    Setting ``parameter.data`` can change all of it and leave the parameter the same object.
    """
    for tensor, shape in zip(tensors, shapes, strict=True):
        if tensor.shape != shape:
            return False
    return in_memory(tensors)


def addresses(tensors: Iterable[th.Tensor]) -> NDArray[np.int64]:
    """Where tensors start in memory."""
    return np.array([tensor.data_ptr() for tensor in tensors])
