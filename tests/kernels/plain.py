"""What kernels work on, and what they are compared with: the same weights in plain torch."""

from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn

from sb3_policyflow.flows import VelocityField, integrate
from sb3_policyflow.kernels import KernelCritic, make_velocity_field

ACTIVATIONS: list[Any] = [
    nn.Mish,
    nn.Tanh,
    nn.SiLU,
    nn.ELU,
    lambda: nn.ELU(0.5),
    nn.ReLU,
    nn.LeakyReLU,
    nn.Sigmoid,
    nn.GELU,
    lambda: nn.GELU(approximate="tanh"),
    nn.Softplus,
    lambda: nn.Softplus(beta=2),
    nn.Hardtanh,
    nn.Identity,
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
) -> VelocityField:
    """A field whose velocity is not zero."""
    return make_velocity_field(
        dim, features_dim, widths, activation, initialization="glorot", **options
    )


def integrate_plainly(
    field: VelocityField, z: th.Tensor, s: th.Tensor, **options: Any
) -> th.Tensor:
    """End points as the definition has them."""
    plain = plain_copy(field)
    return integrate(lambda x, t: plain(x, t, s), z, **options)


class Critic(nn.Module):
    """A critic where SB3's policies have theirs, evaluated by kernels.

    :param layers: Linear layers and the activations between them.
    """

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.plain = nn.Sequential(*layers)
        self.mlp_extractor = MlpExtractor(1, {"pi": [], "vf": []}, nn.Tanh)
        self.mlp_extractor.value_net = self.plain[:-1]
        self.value_net = layers[-1]
        self._kernel_critic = KernelCritic()

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        values = self._kernel_critic(self, inputs)
        assert values is not None
        return values
