"""What an update consists of: an algorithm's part of it, metrics, optimizer and gradients."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any, NamedTuple

import torch as th

from sb3_policyflow.common.buffers import FlowRolloutBufferSamples
from sb3_policyflow.common.losses import SURROGATES
from sb3_policyflow.flows import MatchingSamples
from sb3_policyflow.kernels import clip_gradients_in_place


class PolicyTerms(NamedTuple):
    """What an algorithm contributes to the loss of a minibatch of n samples.

    ``log_ratio`` has shape (n, ...), with one entry for each surrogate; ``kl`` has no dimensions
    and measures the change of the policy in nats; ``regularizer`` is added to the loss; the means
    of ``metrics`` over the minibatches are logged under ``train/``.
    """

    log_ratio: th.Tensor
    kl: th.Tensor
    regularizer: th.Tensor
    metrics: dict[str, th.Tensor]


class FlowUpdate(ABC):
    """An algorithm's part of the update of one rollout.

    It is made before the first gradient step, so that it can remember the policy that collected
    the rollout: the reference policy.

    ``clip_range`` is epsilon, one number or of a shape that broadcasts with a log ratio (n, ...).
    Log ratios beyond ``log_ratio_clamp`` have no gradient; None for no bound.
    ``surrogate_weights`` weigh the surrogates of a sample, of the trailing shape of a log ratio;
    None for 1. If ``trains_actor`` is False, only the critic learns from the rollout.

    :param algorithm: The algorithm, whose policy has not been updated yet.
    :param rollout: The whole rollout of n samples.
    """

    def __init__(self, algorithm: Any, rollout: FlowRolloutBufferSamples) -> None:
        self.rollout = rollout
        self.batch_size: int = algorithm.batch_size
        self.trust_region: str = algorithm.trust_region
        self.clip_range: float | th.Tensor = algorithm.value_of("clip_range")
        self.log_ratio_clamp: float | None = None
        self.surrogate_weights: th.Tensor | None = None
        self.trains_actor: bool = algorithm.n_rollouts >= algorithm.n_critic_warmup
        self.pull: ImitationPull | None = None
        if (coef := algorithm.value_of("imitation_coef")) > 0:
            self.pull = ImitationPull(algorithm.policy, algorithm.cloned_parameters, coef)

    @abstractmethod
    def draw(self) -> tuple[th.Tensor, ...]:
        """What an epoch draws anew for each sample: a NamedTuple of tensors (n, ...)."""

    @abstractmethod
    def terms(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> PolicyTerms:
        """The terms of the policy loss.

        :param batch: A minibatch of n samples, with what was drawn for them.
        :param features: The actor's features, shape (n, features_dim).
        """

    def all_terms(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> PolicyTerms:
        """The terms of the policy loss, with the pull towards a cloned policy if there is one.

        Takes the arguments of :meth:`terms`.
        """
        terms = self.terms(batch, features)
        return terms if self.pull is None else self.pull.added_to(terms, batch, features)

    def surrogate_loss(
        self, log_ratio: th.Tensor, advantages: th.Tensor, metrics: "UpdateMetrics"
    ) -> th.Tensor:
        """The negative surrogate objective, which keeps the policy near the reference policy.

        :param log_ratio: log rho, shape (n, ...), with one entry for each surrogate.
        :param advantages: A, shape (n,).
        :param metrics: Takes the loss and what is to be logged of the ratios.
        :return: The mean over samples and surrogates, a tensor without dimensions.
        """
        metrics.add_maxima({"log_ratio_max": log_ratio.detach().abs().max()})
        if self.log_ratio_clamp is not None:
            log_ratio = log_ratio.clamp(-self.log_ratio_clamp, self.log_ratio_clamp)
        advantages = advantages.reshape(-1, *[1] * (log_ratio.dim() - 1))
        objective = SURROGATES[self.trust_region](log_ratio, advantages, self.clip_range)
        if self.surrogate_weights is not None:
            objective = self.surrogate_weights * objective
        ratio = log_ratio.detach().exp()
        is_clipped = (ratio - 1).abs() > self.clip_range
        loss = -objective.mean()
        metrics.add_means(
            {
                "policy_gradient_loss": loss,
                "clip_fraction": is_clipped.float().mean(),
                "ratio_mean": ratio.mean(),
            }
        )
        return loss


def matched_outputs(policy: Any, drawn: MatchingSamples, features: th.Tensor) -> th.Tensor:
    """What a policy's network says at the points of flow matching, shape (n, action_dim).

    :param policy: The policy.
    :param drawn: The points.
    :param features: The actor's features, shape (n, features_dim).
    """
    # Behind its own, DPPO has features for networks that are not trained.
    features = features[:, : policy.mlp_extractor.latent_dim_pi]
    outputs: th.Tensor = policy.velocity(drawn.points, drawn.times, features)
    return outputs


class ImitationPull:
    """Pulls a policy towards the one that was cloned from demonstrations.

    coef E ||g (v - v_cloned)||^2    at points on the way from drawn latents to the actions taken

    v is the velocity, and g = 1; of DPPO the network's output, which g turns into what the mean of
    the next step changes by.

    :param policy: The policy that learns.
    :param parameters: Its parameters when it had been cloned, by name.
    :param coef: Weight of the pull at the present progress.
    """

    def __init__(self, policy: Any, parameters: Mapping[str, Any], coef: float) -> None:
        self._policy, self._coef = policy, coef
        self._cloned = deepcopy(policy).requires_grad_(False)
        tensors = {name: th.as_tensor(values) for name, values in parameters.items()}
        self._cloned.load_state_dict(tensors, strict=False)
        self._cloned.set_training_mode(False)

    def added_to(
        self, terms: PolicyTerms, batch: FlowRolloutBufferSamples, features: th.Tensor
    ) -> PolicyTerms:
        """The terms of a minibatch with the pull among them.

        :param terms: Those of the algorithm.
        :param batch: The minibatch of n samples.
        :param features: The actor's features, shape (n, features_dim).
        """
        drawn = self._policy.draw_matching(batch.actions.flatten(1))
        with th.no_grad():
            cloned_features = self._cloned.actor_features(batch.observations)
            cloned = matched_outputs(self._cloned, drawn, cloned_features)
        change = matched_outputs(self._policy, drawn, features) - cloned
        loss = (drawn.gains.unsqueeze(-1) * change).square().sum(dim=-1).mean()
        return terms._replace(
            regularizer=terms.regularizer + self._coef * loss,
            metrics={**terms.metrics, "imitation_loss": loss},
        )


class UpdateMetrics:
    """Collects tensors for each minibatch and brings them to the host in one transfer.

    >>> metrics = UpdateMetrics()
    >>> metrics.add_means({"loss": th.tensor(1.0)})
    >>> metrics.add_means({"loss": th.tensor(3.0)})
    >>> metrics.add_maxima({"log_ratio_max": th.tensor(0.5)})
    >>> metrics.summary()
    {'loss': 2.0, 'log_ratio_max': 0.5}
    """

    def __init__(self) -> None:
        self._to_average: dict[str, list[th.Tensor]] = {}
        self._to_maximize: dict[str, list[th.Tensor]] = {}

    def add_means(self, metrics: Mapping[str, th.Tensor]) -> None:
        """Add metrics of one minibatch, tensors without dimensions, that are averaged."""
        for name, value in metrics.items():
            self._append(self._to_average.setdefault(name, []), value)

    def add_maxima(self, metrics: Mapping[str, th.Tensor]) -> None:
        """Add metrics of one minibatch of which the greatest counts."""
        for name, value in metrics.items():
            self._append(self._to_maximize.setdefault(name, []), value)

    @staticmethod
    def _append(values: list[th.Tensor], value: th.Tensor) -> None:
        values.append(value.detach())
        if len(values) == 32:
            # Many small tensors would keep the memory between them from being used again.
            values[:] = [th.hstack(values)]

    def summary(self) -> dict[str, float]:
        """Each metric over all minibatches."""
        reduced = {name: th.hstack(values).mean() for name, values in self._to_average.items()}
        reduced |= {name: th.hstack(values).max() for name, values in self._to_maximize.items()}
        if not reduced:
            return {}
        return dict(zip(reduced, th.stack(list(reduced.values())).tolist(), strict=True))


def make_optimizer(
    optimizer_class: type[th.optim.Optimizer],
    parameters: Iterable[th.nn.Parameter],
    learning_rate: float,
    options: dict[str, Any],
) -> th.optim.Optimizer:
    """An optimizer, in its fused implementation if it has one and the user does not choose.

    >>> make_optimizer(th.optim.Adam, [th.nn.Parameter(th.ones(1))], 1e-3, {}).defaults["fused"]
    True

    :param optimizer_class: Its class.
    :param parameters: What it optimizes.
    :param learning_rate: Its learning rate.
    :param options: Its other arguments.
    """
    arguments = {"lr": learning_rate, **options}
    is_open = not {"fused", "foreach", "capturable", "differentiable"} & options.keys()
    if optimizer_class in (th.optim.Adam, th.optim.AdamW) and is_open:
        parameters = list(parameters)
        try:
            return optimizer_class(parameters, fused=True, **arguments)
        except RuntimeError:
            pass  # torch has no such implementation for this device
    return optimizer_class(parameters, **arguments)


def clip_gradients(parameters: Iterable[th.nn.Parameter], max_norm: float | None = None) -> float:
    """Scale the gradients to a Euclidean norm of all together, if theirs is greater.

    Gradients that are not finite are left alone.

    :param parameters: Parameters, at least one with a gradient.
    :param max_norm: The norm; no bound if None or not positive.
    :return: The norm that they had.
    """
    max_norm = max_norm if max_norm is not None and max_norm > 0 else math.inf
    grads = [p.grad for p in parameters if p.grad is not None]
    norm = clip_gradients_in_place(grads, max_norm)
    if norm is not None:
        return norm
    norm = float(th.cat([grad.reshape(-1) for grad in grads]).norm())
    factor = max_norm / (norm + 1e-6)
    if factor < 1 and math.isfinite(norm):
        th._foreach_mul_(grads, factor)
    return norm


def check_step(loss: float, norm: float, num_timesteps: int, advice: str) -> None:
    """Refuse a step of the optimizer that would spoil the parameters.

    :param loss: The loss.
    :param norm: Euclidean norm of its gradient.
    :param num_timesteps: When, for the message.
    :param advice: What helps besides a lower learning rate, for the message.
    :raises FloatingPointError: If one of them is not finite.
    """
    if math.isfinite(loss) and math.isfinite(norm):
        return
    what = "gradient" if math.isfinite(loss) else "loss"
    raise FloatingPointError(
        f"The {what} is not finite (loss {loss}, {num_timesteps} timesteps). The parameters are "
        f"those of the last good step and can be saved: lower the learning rate{advice}."
    )
