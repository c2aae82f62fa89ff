"""The update that all flow algorithms share: PPO's, for policies without a likelihood."""

import math
import sys
from abc import abstractmethod
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.utils import explained_variance
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from sb3_policyflow.common.arguments import FlowAlgorithmArguments
from sb3_policyflow.common.losses import SURROGATES
from sb3_policyflow.common.metrics import UpdateMetrics
from sb3_policyflow.common.optimization import clip_gradients
from sb3_policyflow.common.type_aliases import FlowRolloutBufferSamples, PolicyTerms


class FlowOnPolicyAlgorithm(FlowAlgorithmArguments):
    """PPO's update around what a sibling says of its policy: :meth:`_policy_terms`.

    For arguments see :class:`~sb3_policyflow.common.arguments.FlowAlgorithmArguments`.
    """

    trust_region: str = "ppo"
    divergence_advice: ClassVar[str] = ""
    """What else than a lower learning rate helps against gradients that are not finite."""

    # What siblings supply

    @abstractmethod
    def _behavior(self, rollout: FlowRolloutBufferSamples) -> Any:
        """What the update must know of the policy that made the rollout, before it changes."""

    @abstractmethod
    def _draw_probes(self, rollout: FlowRolloutBufferSamples, behavior: Any) -> Any:
        """What an epoch draws anew for each sample: a NamedTuple of tensors (n, ...)."""

    @abstractmethod
    def _policy_terms(
        self, batch: FlowRolloutBufferSamples, features: th.Tensor, behavior: Any
    ) -> PolicyTerms:
        """The terms of the policy loss.

        :param batch: A minibatch of n samples, with their probes.
        :param features: The actor's features, shape (n, features_dim).
        :param behavior: What :meth:`_behavior` returned.
        """

    # The update

    def train(self) -> None:
        """Update the policy with the rollout in the buffer (paper, algorithm 1, second half)."""
        rollout = self._rollout()
        self.policy.set_training_mode(False)
        behavior = self._behavior(rollout)
        self._update_learning_rate(self.policy.optimizer)
        metrics, divergences = UpdateMetrics(), list[th.Tensor]()
        for _ in range(self.n_epochs):
            if self.kl_window == "epoch":
                divergences.clear()
            probes = self._draw_probes(rollout, behavior)
            finished = self._train_epoch(
                rollout._replace(probes=probes), behavior, metrics, divergences
            )
            self._n_updates += 1
            if not finished:
                break
        self._log_update(metrics, th.stack(divergences).mean().item())

    def _rollout(self) -> FlowRolloutBufferSamples:
        """The rollout, with advantages normalized if that is done over all of it."""
        rollout = self.rollout_buffer.samples()
        if self.normalize_advantage and self.advantage_scope == "rollout":
            return rollout._replace(advantages=_normalized(rollout.advantages))
        return rollout

    def _train_epoch(
        self,
        rollout: FlowRolloutBufferSamples,
        behavior: Any,
        metrics: UpdateMetrics,
        divergences: list[th.Tensor],
    ) -> bool:
        """Go through the rollout once; False if the policy has gone too far from the old one."""
        self.policy.set_training_mode(True)
        parameters = list(self.policy.parameters())
        for batch in self.rollout_buffer.minibatches(rollout, self.batch_size):
            loss, kl, figures = self._loss(batch, behavior)
            metrics.add(figures)
            divergences.append(kl.detach())
            if self.target_kl is not None and kl.item() > 1.5 * self.target_kl:
                if self.verbose >= 1:
                    sys.stdout.write(f"Early stopping due to reaching max kl: {kl.item():.2f}\n")
                # The epoch has no end to adapt at, and this is what is wrong with the rate.
                self._adapt_learning_rate(divergences[-1:])
                return False
            self._optimize(loss, parameters)
            if self.lr_adaptation == "minibatch":
                self._adapt_learning_rate(divergences[-1:])
        if self.lr_adaptation == "epoch":
            self._adapt_learning_rate(divergences)
        return True

    def _loss(
        self, batch: FlowRolloutBufferSamples, behavior: Any
    ) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """The loss of a minibatch, the divergence of the policy, and figures to log."""
        actor_features, critic_features = self._features(batch)
        terms = self._policy_terms(batch, actor_features, behavior)
        policy_loss = -self._surrogate(terms.log_ratio, self._advantages(batch)).mean()
        value_loss = self._value_loss(batch, self.policy.values(critic_features).flatten())
        loss = policy_loss + terms.regularizer + self.vf_coef * value_loss
        figures = {
            "policy_gradient_loss": policy_loss,
            "value_loss": value_loss,
            **self._ratio_figures(terms.log_ratio.detach()),
            **terms.metrics,
        }
        self._last_loss = loss.detach()
        return loss, terms.kl, figures

    def _features(self, batch: FlowRolloutBufferSamples) -> tuple[th.Tensor, th.Tensor]:
        """Features of a minibatch for actor and critic, each of shape (n, features_dim)."""
        return self.policy.actor_critic_features(batch.observations)

    def _advantages(self, batch: FlowRolloutBufferSamples) -> th.Tensor:
        """Advantages of a minibatch, shape (n,)."""
        per_minibatch = self.normalize_advantage and self.advantage_scope == "minibatch"
        # A minibatch of one sample has no standard deviation.
        if per_minibatch and len(batch.advantages) > 1:
            return _normalized(batch.advantages)
        return batch.advantages

    def _surrogate(self, log_ratio: th.Tensor, advantages: th.Tensor) -> th.Tensor:
        """The objective within the trust region, of the shape (n, ...) of ``log_ratio``."""
        advantages = advantages.reshape(-1, *[1] * (log_ratio.dim() - 1))
        return SURROGATES[self.trust_region](log_ratio, advantages, self._clip_range_now())

    def _clip_range_now(self) -> float | th.Tensor:
        """Epsilon at the present progress, one number or of a shape that fits the log ratio."""
        return self._now(self.clip_range)

    def _value_loss(self, batch: FlowRolloutBufferSamples, values: th.Tensor) -> th.Tensor:
        """Mean squared error of the (clipped) values against the TD(lambda) returns."""
        if self.clip_range_vf is not None:
            clip_range_vf = self._now(self.clip_range_vf)
            change = (values - batch.old_values).clamp(-clip_range_vf, clip_range_vf)
            values = batch.old_values + change
        return F.mse_loss(batch.returns, values)

    @th.no_grad()
    def _ratio_figures(self, log_ratio: th.Tensor) -> dict[str, th.Tensor]:
        ratio = log_ratio.exp()
        clipped = (ratio - 1).abs() > self._clip_range_now()
        return {
            "clip_fraction": clipped.float().mean(),
            "ratio_mean": ratio.mean(),
            "log_ratio_max": log_ratio.abs().max(),
        }

    def _optimize(self, loss: th.Tensor, parameters: list[th.nn.Parameter]) -> None:
        """Take one step of the optimizer.

        :raises FloatingPointError: If loss or gradient are not finite; parameters are left alone.
        """
        for parameter in parameters:
            parameter.grad = None
        th.autograd.backward(loss)
        clips = self.max_grad_norm is not None and self.max_grad_norm > 0
        norm = clip_gradients(parameters, self.max_grad_norm if clips else math.inf)
        if not (math.isfinite(norm) and th.isfinite(loss)):
            what = "gradient" if th.isfinite(loss) else "loss"
            raise FloatingPointError(
                f"The {what} is not finite (loss {loss.item()}, {self.num_timesteps} timesteps). "
                "The parameters are those of the last good step and can be saved: lower the "
                f"learning rate{self.divergence_advice}."
            )
        self.policy.optimizer.step()
        self.policy.keep_within_bounds()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_last_loss"]

    # The log

    def _log_policy(self) -> None:
        """Log what else is worth knowing of the policy after an update."""

    def _log_update(self, metrics: UpdateMetrics, approx_kl: float) -> None:
        for name, value in metrics.summary().items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/approx_kl", approx_kl)
        self.logger.record("train/loss", self._last_loss.item())
        buffer = self.rollout_buffer
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", explained)
        self._log_policy()
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", self._now(self.clip_range))
        if self.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", self._now(self.clip_range_vf))


def _normalized(advantages: th.Tensor) -> th.Tensor:
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)
