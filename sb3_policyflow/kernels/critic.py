"""The critic of a policy, evaluated and differentiated by kernels."""

from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import MlpExtractor

from sb3_policyflow.kernels.inspection import KernelView, ModuleInspector
from sb3_policyflow.kernels.layouts import Kernels
from sb3_policyflow.kernels.mlp import MLP, evaluate_mlp, read_mlp


def read_critic(kernels: Kernels, inspector: ModuleInspector, policy: Any) -> MLP:
    """Read the critic behind the features, or raise :class:`UnsupportedError`."""
    inspector.children(policy)
    extractor = policy.mlp_extractor
    inspector.require_method(extractor, "forward_critic", MlpExtractor.forward_critic)
    inspector.require_no_hooks(extractor)
    hidden = inspector.sequence(extractor, "value_net")
    return read_mlp(kernels, inspector, [*hidden, policy.value_net])


class KernelCritic:
    """Evaluates the critic of an SB3 policy where kernels can.

    It keeps what it read from the policy; a copy reads for itself.
    """

    def __init__(self) -> None:
        self._view = KernelView(read_critic)

    def __call__(self, policy: Any, features: th.Tensor) -> th.Tensor | None:
        """Estimate values.

        :param policy: A policy with SB3's ``mlp_extractor`` and ``value_net``.
        :param features: The critic's features, shape (n, features_dim).
        :return: Values, shape (n, 1), or None where kernels cannot work.
        """
        network = self._view.of(policy)
        return None if isinstance(network, str) else evaluate_mlp(network, features)
