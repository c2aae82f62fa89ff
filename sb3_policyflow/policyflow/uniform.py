"""Flow matching towards uniform actions, as an entropy regularizer."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_policyflow.common.schedules import is_zero
from sb3_policyflow.flows import Interpolant, VelocityField
from sb3_policyflow.flows.bounds import SHORTEST_MEANINGLESS, half_ranges
from sb3_policyflow.policyflow.policies import PolicyFlowPolicy


class UniformTargets:
    """Trains a flow towards the uniform distribution over the actions.

    E ||v(x_t, t, s) - dx_t/dt||^2,    x_t between a latent z and u ~ U(actions),  t ~ U(0, T)

    The diffusion entropy regularization of Ding et al. (2024), "Diffusion-based Reinforcement
    Learning via Q-weighted Variational Policy Optimization", https://arxiv.org/abs/2405.16173,
    with flow matching in place of its noise prediction; summed over action dimensions.

    :param action_space: The actions; SB3 takes bounded ones only.
    :param interpolant: The interpolant of the update.
    :param latent_std: Standard deviation of the latents: a number, or one for each dimension.
    :param device: Where the actions are.
    :raises ValueError: If the interpolant draws noise of its own, or actions have no bounds that
        mean something.
    """

    def __init__(
        self,
        action_space: spaces.Box,
        interpolant: Interpolant,
        latent_std: float | th.Tensor = 1.0,
        device: th.device | str = "cpu",
    ) -> None:
        if interpolant.stochastic:
            raise ValueError(
                "uniform_noise_coef needs an interpolant without noise of its own: use "
                "interpolant='rectified' or interpolant='trigflow'."
            )
        if not np.isfinite(half_ranges(action_space.low, action_space.high)).all():
            raise ValueError(
                "uniform_noise_coef spreads actions over their space, which has no bounds if they "
                f"are {SHORTEST_MEANINGLESS:g} or more apart: use brownian_coef."
            )
        self._interpolant = interpolant
        self._latent_std = latent_std
        self._low = th.as_tensor(action_space.low, device=device).flatten()
        self._high = th.as_tensor(action_space.high, device=device).flatten()

    @classmethod
    def of(cls, policy: PolicyFlowPolicy) -> "UniformTargets":
        """The targets of a policy's flow."""
        assert isinstance(policy.action_space, spaces.Box)
        interpolant, scale = policy.flow.interpolant, policy.latent_scale
        return cls(policy.action_space, interpolant, scale, policy.device)

    def loss(self, velocity: VelocityField, features: th.Tensor) -> th.Tensor:
        """The mean squared error of the velocity.

        :param velocity: v, the field.
        :param features: The actor's features, shape (n, features_dim).
        :return: The loss, a tensor without dimensions.
        """
        low, high = self._low.to(features), self._high.to(features)
        uniform = low + (high - low) * features.new_empty(len(features), len(low)).uniform_()
        latents = self._latent_std * th.randn_like(uniform)
        times = self._interpolant.end_time * features.new_empty(len(features)).uniform_()
        points = self._interpolant.interpolate(latents, uniform, times)
        target = self._interpolant.derivative(latents, uniform, times)
        error: th.Tensor = velocity(points, times, features) - target
        return error.square().sum(-1).mean()


def check_regularizers(model: Any) -> None:
    """Refuse regularizers that the policy cannot have.

    :param model: A PolicyFlow.
    :raises ValueError: If there is no flow, or one that is stochastic, for them to act on.
    """
    coefficients = model.brownian_coef, model.uniform_noise_coef
    if model.policy.gaussian and not all(map(is_zero, coefficients)):
        raise ValueError(
            "A Gaussian policy has no flow to spread: with gaussian=True leave brownian_coef "
            "and uniform_noise_coef at 0, and use ent_coef."
        )
    if not is_zero(model.uniform_noise_coef):
        UniformTargets.of(model.policy)
