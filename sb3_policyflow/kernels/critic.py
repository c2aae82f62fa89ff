"""The critic of a policy, evaluated and differentiated by kernels."""

from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import MlpExtractor

from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.inspection import KernelView, ModuleInspector, UnsupportedError
from sb3_policyflow.kernels.layouts import Kernels
from sb3_policyflow.kernels.mlp import MLP, evaluate_mlp, read_mlp


def _read_critic(kernels: Kernels, inspector: ModuleInspector, policy: Any) -> MLP:
    """Read the critic behind the features, or raise :class:`UnsupportedError`."""
    inspector.children(policy)
    extractor = policy.mlp_extractor
    if type(extractor) is not MlpExtractor:
        raise UnsupportedError(f"{type(extractor).__name__} takes the place of SB3's MlpExtractor")
    inspector.children(extractor)
    hidden = extractor.value_net
    inspector.require_no_hooks(extractor, hidden)
    return read_mlp(kernels, inspector, [*inspector.children(hidden), policy.value_net])


class KernelCritic:
    """Evaluates the critic of an SB3 policy where kernels can.

    It keeps what it read from the policy; a copy reads for itself.
    """

    def __init__(self) -> None:
        self._view = KernelView(_read_critic)

    def __call__(self, policy: Any, features: th.Tensor) -> th.Tensor | None:
        """Estimate values.

        :param policy: A policy with SB3's ``mlp_extractor`` and ``value_net``.
        :param features: The critic's features, shape (n, features_dim).
        :return: Values, shape (n, 1), or None where kernels cannot work.
        """
        network = self._view.of(policy)
        return None if isinstance(network, str) else evaluate_mlp(network, features)


def reason_kernels_are_off(policy: Any) -> str | None:
    """Why kernels work on a policy's networks only in part or not at all.

    :param policy: A policy whose ``velocity`` :func:`make_velocity_field` made, with SB3's critic.
    :return: A part of a sentence; None if they work on actor and critic.
    """
    if not isinstance(policy.velocity, KernelVelocityField):
        return f"{type(policy.velocity).__name__} is not a velocity field of kernels"
    actor = policy.velocity.parts()
    if isinstance(actor, str):
        return actor
    critic = KernelView(_read_critic).of(policy)
    return f"for the critic, {critic}" if isinstance(critic, str) else None
