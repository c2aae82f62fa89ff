"""What a training costs: gradient steps and evaluations of networks."""

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_policyflow.common.ode_policy import OdeFlowPolicy
from sb3_policyflow.dppo import DPPO
from sb3_policyflow.dppo.policies import DPPOPolicy
from sb3_policyflow.flows import SOLVERS
from sb3_policyflow.fpo import FPO
from sb3_policyflow.policyflow import PolicyFlow


class GradientSteps:
    """Counts the steps of a model's optimizer."""

    def __init__(self, model: OnPolicyAlgorithm) -> None:
        self.count = 0
        model.policy.optimizer.register_step_post_hook(self._count)

    def _count(self, *_: Any) -> None:
        self.count += 1


def evaluations_per_action(model: BaseAlgorithm) -> int:
    """Evaluations of the actor's network that one action takes."""
    policy = model.policy
    if isinstance(policy, OdeFlowPolicy):
        return policy.n_flow_steps * SOLVERS[policy.solver].evaluations
    return policy.n_denoising_steps if isinstance(policy, DPPOPolicy) else 1


def evaluations_per_sample(model: BaseAlgorithm) -> int:
    """Evaluations of the actor's network with which one sample enters one gradient step.

    PolicyFlow's old velocity counts, which each epoch looks up anew; FPO's old losses, of which
    there is one for all epochs, do not; neither does what an entropy bonus takes.
    """
    if isinstance(model, PolicyFlow):
        return 2 * model.n_times
    if isinstance(model, FPO):
        return model.n_probes
    if isinstance(model, DPPO):
        return len(model.policy.log_prob_stds)
    return 1


def network_evaluations(model: OnPolicyAlgorithm, gradient_steps: int) -> dict[str, int]:
    """Evaluations of the actor's network for acting and for updating, over a training.

    Those for updating are of full minibatches: the last of an epoch may have been smaller.
    """
    # A2C, which has no minibatches, updates with the whole rollout.
    batch_size = getattr(model, "batch_size", model.n_steps * model.n_envs)
    return {
        "acting": model.num_timesteps * evaluations_per_action(model),
        "updating": gradient_steps * batch_size * evaluations_per_sample(model),
    }
