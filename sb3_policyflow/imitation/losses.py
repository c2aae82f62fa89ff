"""What makes a policy's actions those that were demonstrated."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.update import matched_outputs


def cloning_losses(policy: Any, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
    """The losses of n demonstrated actions, whose mean is to be minimized, shape (n,).

    - A flow (PolicyFlow, FPO): conditional flow matching along its interpolant.
    - A chain (DPPO): the denoising loss of its process.
    - A Gaussian policy (PolicyFlow with ``gaussian=True``, SB3's PPO): minus the log likelihood.

    :param policy: The policy.
    :param observations: Preprocessed observations.
    :param actions: Demonstrated actions as the policy makes them, shape (n, ...).
    """
    if not isinstance(policy, FlowPolicy):
        _, log_prob, _ = policy.evaluate_actions(observations, actions)
        return -log_prob
    features = policy.actor_features(observations)
    actions = actions.flatten(1)
    if getattr(policy, "gaussian", False):
        return gaussian_losses(policy, features, actions)
    drawn = policy.draw_matching(actions)
    error = matched_outputs(policy, drawn, features) - drawn.targets
    return drawn.weights * error.square().sum(dim=-1)


def gaussian_losses(policy: Any, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Minus the log likelihood of actions around the end point of the latent 0, shape (n,)."""
    latents = features.new_zeros(len(features), policy.action_dim)
    means = policy.transport(latents, features)
    normal = th.distributions.Normal(means, policy.noise_log_std.exp())
    return -normal.log_prob(actions).sum(dim=-1)
