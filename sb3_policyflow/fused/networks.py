"""Reading networks: which of them the kernels know, and where their parameters are."""

from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import torch as th
from torch import nn

T = TypeVar("T")


class Activation(NamedTuple):
    """An activation by its name among the kernels, and its parameter."""

    name: str
    alpha: float = 0.0


class Layer(NamedTuple):
    """The parameters of a linear layer: shapes (n_out, n_in) and (n_out,)."""

    weight: th.Tensor
    bias: th.Tensor


class Perceptron(NamedTuple):
    """Linear layers, at least two, with one activation between them."""

    layers: list[Layer]
    activation: Activation


_SIMPLE: dict[type[nn.Module], Activation] = {
    nn.ReLU: Activation("RELU"),
    nn.Tanh: Activation("TANH"),
    nn.Sigmoid: Activation("SIGMOID"),
    nn.SiLU: Activation("SILU"),
    nn.Mish: Activation("MISH"),
}


class Reader:
    """Reads parameters from modules, and remembers where from.

    Modules with hooks are refused: hooks are how pruning, weight normalisation and those who watch
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
        for place, name, thing in self._places:
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
        return not any(hooks)

    def children(self, module: nn.Module) -> list[nn.Module]:
        """The modules within a module."""
        self._places += [(module._modules, name, child) for name, child in module._modules.items()]
        return [child for child in module._modules.values() if child is not None]

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
        (Activation(name='ELU', alpha=0.5), None)
        """
        if not self.is_plain(module):
            return None
        if type(module) is nn.ELU:
            self._places.append((module.__dict__, "alpha", module.alpha))
            return Activation("ELU", module.alpha)
        if type(module) is nn.LeakyReLU:
            self._places.append((module.__dict__, "negative_slope", module.negative_slope))
            return Activation("LEAKY_RELU", module.negative_slope)
        return _SIMPLE.get(type(module))

    def perceptron(self, modules: Iterable[nn.Module]) -> Perceptron | None:
        """The network that the modules make up, or None if it is of another kind.

        >>> modules = [nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1)]
        >>> Reader().perceptron(modules).activation
        Activation(name='TANH', alpha=0.0)
        >>> Reader().perceptron([*modules, nn.Tanh()]) is None
        True
        """
        modules = list(modules)
        layers = [self.layer(module) for module in modules[::2]]
        activations = {self.activation(module) for module in modules[1::2]}
        known = [layer for layer in layers if layer is not None]
        if len(activations) != 1 or len(modules) % 2 == 0 or len(known) < len(layers):
            return None
        activation = activations.pop()
        return None if activation is None else Perceptron(known, activation)


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
        if module is not self._module or not self._reader.holds():
            self._module, self._reader = module, Reader()
            self._found = self._read(self._reader, module)
        return self._found


def in_memory(tensors: Iterable[th.Tensor]) -> bool:
    """Whether kernels can read these tensors: contiguous float32 on the CPU."""
    for tensor in tensors:
        if tensor.dtype is not th.float32 or not tensor.is_cpu or not tensor.is_contiguous():
            return False
    # Within torch.func's transformations, tensors stand for others.
    return th._C._functorch.peek_interpreter_stack() is None
