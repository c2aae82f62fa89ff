"""Reading networks: which of them, and which of their tensors, the kernels can work on."""

from collections.abc import Iterable
from typing import NamedTuple

import torch as th
from torch import nn


class Activation(NamedTuple):
    """An activation by its name among the kernels, and its parameter."""

    name: str
    alpha: float = 0.0


class Perceptron(NamedTuple):
    """Linear layers with one activation between them: (weight, bias) of each."""

    parameters: list[tuple[th.Tensor, th.Tensor]]
    activation: Activation


_SIMPLE: dict[type[nn.Module], Activation] = {
    nn.ReLU: Activation("RELU"),
    nn.Tanh: Activation("TANH"),
    nn.Sigmoid: Activation("SIGMOID"),
    nn.SiLU: Activation("SILU"),
    nn.Mish: Activation("MISH"),
}


def known_activation(module: nn.Module) -> Activation | None:
    """An activation as the kernels know it, or None.

    >>> known_activation(nn.ELU(0.5)), known_activation(nn.GELU())
    (Activation(name='ELU', alpha=0.5), None)
    """
    if type(module) is nn.ELU:
        return Activation("ELU", module.alpha)
    if type(module) is nn.LeakyReLU:
        return Activation("LEAKY_RELU", module.negative_slope)
    return _SIMPLE.get(type(module))


def is_plain(module: nn.Module) -> bool:
    """Whether a module does nothing beside its own computation.

    Hooks are how pruning, weight normalisation and those who watch activations take part.
    """
    return not (
        module._forward_hooks
        or module._forward_pre_hooks
        or module._backward_hooks
        or module._backward_pre_hooks
    )


def linear_parameters(module: nn.Module) -> tuple[th.Tensor, th.Tensor] | None:
    """Weight and bias of a layer that is nothing but linear, or None."""
    if type(module) is not nn.Linear or not is_plain(module):
        return None
    parameters = module._parameters
    weight, bias = parameters.get("weight"), parameters.get("bias")
    return None if weight is None or bias is None else (weight, bias)


def read_perceptron(modules: Iterable[nn.Module]) -> Perceptron | None:
    """The network that the modules make up, or None if it is another kind of network.

    >>> layers = nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1)
    >>> read_perceptron(layers).activation
    Activation(name='TANH', alpha=0.0)
    >>> read_perceptron([*layers, nn.Tanh()]) is None
    True
    """
    found: list[tuple[th.Tensor, th.Tensor]] = []
    activation: Activation | None = None
    is_linear = False
    for module in modules:
        is_linear = not is_linear
        if is_linear:
            layer = linear_parameters(module)
            if layer is None:
                return None
            found.append(layer)
        else:
            known = known_activation(module) if is_plain(module) else None
            if known is None or activation not in (None, known):
                return None
            activation = known
    return Perceptron(found, activation) if is_linear and activation is not None else None


def is_served(*tensors: th.Tensor) -> bool:
    """Whether kernels can read these tensors in memory."""
    if th._C._functorch.peek_interpreter_stack() is not None:
        return False
    return all(
        tensor.dtype is th.float32 and tensor.is_cpu and tensor.is_contiguous()
        for tensor in tensors
    )
