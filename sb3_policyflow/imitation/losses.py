"""What makes a policy's actions those that were demonstrated."""

import math
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_policyflow.common.losses import matched_outputs
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.flows import MatchingSamples
from sb3_policyflow.policyflow import PolicyFlowPolicy

HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


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
        log_prob: th.Tensor = policy.evaluate_actions(observations, actions)[1]
        return -log_prob
    features = policy.actor_features(observations)
    actions = actions.flatten(1)
    if isinstance(policy, PolicyFlowPolicy) and policy.gaussian:
        return gaussian_losses(policy, features, actions)
    own: Any = policy
    drawn: MatchingSamples = own.draw_matching(actions)
    error = matched_outputs(policy, drawn, features) - drawn.targets
    return drawn.weights * error.square().sum(dim=-1)


def gaussian_losses(policy: PolicyFlowPolicy, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Minus the log likelihood of actions around the end point of the latent 0, shape (n,)."""
    latents = features.new_zeros(len(features), policy.action_dim)
    noise = (actions - policy.transport(latents, features)) / policy.noise_log_std.exp()
    log_scales = policy.noise_log_std + HALF_LOG_2_PI
    return (0.5 * noise.square() + log_scales).sum(dim=-1)
