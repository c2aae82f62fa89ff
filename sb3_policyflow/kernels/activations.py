"""The activations that kernels know."""

from typing import NamedTuple

from torch import nn

RELU, LEAKY_RELU, ELU, TANH, SIGMOID, SILU, MISH = range(7)


class Activation(NamedTuple):
    """An activation's number, and its parameter."""

    kind: int
    alpha: float = 0.0


PLAIN: dict[type[nn.Module], Activation] = {
    nn.ReLU: Activation(RELU),
    nn.Tanh: Activation(TANH),
    nn.Sigmoid: Activation(SIGMOID),
    nn.SiLU: Activation(SILU),
    nn.Mish: Activation(MISH),
}
"""Those without a parameter."""

WITH_ALPHA: dict[type[nn.Module], tuple[int, str]] = {
    nn.ELU: (ELU, "alpha"),
    nn.LeakyReLU: (LEAKY_RELU, "negative_slope"),
}
"""Those with one, and the attribute that holds it."""
