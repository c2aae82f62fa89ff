"""The activations that kernels know."""

from collections.abc import Callable
from typing import NamedTuple

from torch import nn

RELU, LEAKY_RELU, ELU, TANH, SIGMOID, SILU, MISH = range(7)
GELU, GELU_TANH, SOFTPLUS, HARDTANH, IDENTITY = range(7, 12)


class Activation(NamedTuple):
    """An activation's number, and its parameter."""

    kind: int
    alpha: float = 0.0


class Known(NamedTuple):
    """Attributes of a module, and the activation that it is with values of them, if any."""

    attributes: tuple[str, ...]
    activation: Callable[..., Activation | None]


def _plain(kind: int) -> Known:
    return Known((), lambda: Activation(kind))


def _with_alpha(kind: int, name: str) -> Known:
    return Known((name,), lambda alpha: Activation(kind, float(alpha)))


def _softplus(beta: float, threshold: float) -> Activation | None:
    return Activation(SOFTPLUS, float(beta)) if threshold == 20 else None


def _hardtanh(low: float, high: float) -> Activation | None:
    return Activation(HARDTANH) if (low, high) == (-1, 1) else None


KNOWN: dict[type[nn.Module], Known] = {
    nn.ReLU: _plain(RELU),
    nn.LeakyReLU: _with_alpha(LEAKY_RELU, "negative_slope"),
    nn.ELU: _with_alpha(ELU, "alpha"),
    nn.Tanh: _plain(TANH),
    nn.Sigmoid: _plain(SIGMOID),
    nn.SiLU: _plain(SILU),
    nn.Mish: _plain(MISH),
    nn.GELU: Known(
        ("approximate",), lambda kind: Activation(GELU_TANH if kind == "tanh" else GELU)
    ),
    nn.Softplus: Known(("beta", "threshold"), _softplus),
    nn.Hardtanh: Known(("min_val", "max_val"), _hardtanh),
    nn.Identity: _plain(IDENTITY),
}
"""The activations by their modules."""
