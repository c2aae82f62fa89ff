"""What a training costs: gradient steps and evaluations of networks."""

from typing import Any

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm


class GradientSteps:
    """Counts the steps of a model's optimizer."""

    def __init__(self, model: OnPolicyAlgorithm) -> None:
        self.count = 0
        model.policy.optimizer.register_step_post_hook(self._count)

    def _count(self, *_: Any) -> None:
        self.count += 1


def network_evaluations(model: OnPolicyAlgorithm, gradient_steps: int) -> dict[str, int]:
    """Evaluations of the actor's network for acting and for updating, over a training.

    Those for updating are of full minibatches: the last of an epoch may have been smaller. The flow
    algorithms say how many evaluations an action, and a sample of a minibatch, takes; SB3's own
    take one.

    :param model: The model, after its training.
    :param gradient_steps: Steps of its optimizer.
    """
    per_action = getattr(model.policy, "n_evaluations_per_action", 1)
    per_sample = getattr(model, "n_evaluations_per_sample", 1)
    # A2C, which has no minibatches, updates with the whole rollout.
    batch_size = getattr(model, "batch_size", model.n_steps * model.n_envs)
    return {
        "acting": model.num_timesteps * per_action,
        "updating": gradient_steps * batch_size * per_sample,
    }
