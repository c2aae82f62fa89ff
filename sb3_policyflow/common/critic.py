"""The networks behind the features, of which a flow policy needs the critic's alone."""

import torch as th
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn


class CriticExtractor(MlpExtractor):
    """The critic's hidden layers. The actor's belong to the velocity field.

    :param features_dim: Size of the features.
    :param layers: Hidden layers.
    :param activation_fn: Their activation.
    :param device: Where to put them.
    """

    def __init__(
        self,
        features_dim: int,
        layers: list[int],
        activation_fn: type[nn.Module],
        device: th.device,
    ) -> None:
        super().__init__(features_dim, {"pi": [], "vf": layers}, activation_fn, device)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """The features as they are, unless somebody has put layers there."""
        network = self.policy_net
        is_empty = type(network) is nn.Sequential and len(network) == 0
        return features if is_empty else super().forward_actor(features)
