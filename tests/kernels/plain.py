"""What kernels are compared with: the same weights in plain torch."""

from typing import Any

import torch as th
from torch import nn

from sb3_policyflow.flows import VelocityField, integrate
from sb3_policyflow.kernels.fields import FusedVelocityField

ACTIVATIONS: list[Any] = [
    nn.Mish,
    nn.Tanh,
    nn.SiLU,
    nn.ELU,
    lambda: nn.ELU(0.5),
    nn.ReLU,
    nn.LeakyReLU,
    nn.Sigmoid,
]
SHAPES = [(1, 1, [8]), (2, 4, [256, 128, 64]), (3, 5, [24, 40]), (6, 17, [64, 64]), (9, 3, [7])]
"""Dimensions of action and features, and hidden layers."""


def plain_copy(field: VelocityField) -> VelocityField:
    """The same field, which kernels do not know."""
    dim, features_dim = field.output.out_features, field.observation_embedding.in_features
    widths = [layer.out_features for layer in field.hidden if isinstance(layer, nn.Linear)]
    activation = field.hidden[1] if widths else nn.Tanh()
    copy = VelocityField(
        dim,
        features_dim,
        widths,
        lambda: activation,  # type: ignore[arg-type]  # shared by all layers
        embedding_dim=field.observation_embedding.out_features,
        frequencies=len(field.time_embedding.frequencies),
    )
    copy.load_state_dict(field.state_dict())
    return copy.to(field.output.weight.dtype)


def make_field(
    dim: int, features_dim: int, widths: list[int], activation: Any = nn.Tanh, **options: Any
) -> FusedVelocityField:
    """A field whose velocity is not zero."""
    return FusedVelocityField(
        dim, features_dim, widths, activation, initialization="glorot", **options
    )


def carry_plainly(field: VelocityField, z: th.Tensor, s: th.Tensor, **options: Any) -> th.Tensor:
    """End points as the definition has them."""
    plain = plain_copy(field)
    return integrate(lambda x, t: plain(x, t, s), z, **options)
