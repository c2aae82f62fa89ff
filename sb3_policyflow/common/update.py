"""What an update consists of: an algorithm's part of it, and its metrics."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple, Protocol

import torch as th

from sb3_policyflow.common.losses import SURROGATES, ImitationPull, clipped_value_loss
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples, Minibatches
from sb3_policyflow.common.optimization import OwnRate
from sb3_policyflow.common.schedules import is_zero
from sb3_policyflow.kernels import has_fixed_features

Metrics = Mapping[str, th.Tensor] | Mapping[str, float]
"""Metrics of one minibatch by name: numbers, or tensors without dimensions."""


class PolicyTerms(NamedTuple):
    """What an algorithm contributes to the loss of a minibatch of n samples.

    ``log_ratio`` has shape (n, ...), with one entry for each surrogate; ``kl`` has no dimensions
    and measures the change of the policy in nats; ``regularizer`` is added to the loss; the means
    of ``metrics`` over the minibatches are logged under ``train/``. ``unclamped`` is the log ratio
    before the algorithm has clamped it; None if it has not.
    """

    log_ratio: th.Tensor
    kl: th.Tensor
    regularizer: th.Tensor
    metrics: dict[str, th.Tensor]
    unclamped: th.Tensor | None = None


class Loss(Protocol):
    """What a step of the optimizer needs of a loss: a tensor is one."""

    def item(self) -> float:
        """Its value."""

    def backward(self, *, inputs: Any = None) -> None:
        """Add its gradients to those of the parameters; of ``inputs`` only, if they are given."""


class EvaluatedTerms(NamedTuple):
    """A minibatch's loss and divergence, see :class:`PolicyTerms`, and what is to be logged.

    Means over the minibatches are logged of ``means``, and the greatest of ``maxima``.
    """

    loss: Loss
    kl: th.Tensor
    means: Metrics
    maxima: Metrics


EvaluateRows = Callable[[slice], EvaluatedTerms | None]
"""Evaluates the loss of some of the samples that were prepared; None if it no longer can."""
CompiledLoss = Callable[[FlowRolloutBufferSamples, th.Tensor, th.Tensor], EvaluateRows | None]
"""Takes samples, and the features of actor and critic; None where kernels cannot work."""


class FlowUpdate(ABC):
    """An algorithm's part of the update of one rollout.

    It is made before the first gradient step, so that it can remember the policy that collected
    the rollout: the reference policy.

    ``clip_range`` is epsilon, one number or of a shape that broadcasts with a log ratio (n, ...).
    Log ratios beyond ``log_ratio_clamp`` have no gradient; None for no bound.
    ``surrogate_weights`` weigh the surrogates of a sample, of the trailing shape of a log ratio;
    None for 1. If ``trains_actor`` is False, only the critic learns from the rollout. If there is a
    ``compiled_loss``, it takes the place of :meth:`loss` where it can, and so does a
    ``recorded_loss``, a graph of it on a GPU. An algorithm whose formulas start the same operations
    for every minibatch, and wait for none, says so as ``class MyUpdate(FlowUpdate,
    may_be_recorded=True)``.

    :param algorithm: The algorithm, whose policy has not been updated yet.
    :param rollout: The whole rollout of n samples.
    """

    may_be_recorded: ClassVar[bool] = False
    """Whether :meth:`loss` may be recorded; a subclass may have any, and must say it itself."""

    def __init_subclass__(cls, may_be_recorded: bool = False) -> None:
        super().__init_subclass__()
        cls.may_be_recorded = may_be_recorded

    def __init__(self, algorithm: Any, rollout: FlowRolloutBufferSamples) -> None:
        self.rollout = rollout
        self.policy: Any = algorithm.policy
        self.vf_coef: float = algorithm.vf_coef
        bounds_values = algorithm.clip_range_vf is not None
        self.clip_range_vf = algorithm.value_of("clip_range_vf") if bounds_values else None
        self.compiled_loss: CompiledLoss | None = None
        self.recorded_loss: Callable[[FlowRolloutBufferSamples], EvaluatedTerms] | None = None
        self.batch_size: int = algorithm.ranks.share("batch_size", algorithm.batch_size)
        self.trust_region: str = algorithm.trust_region
        self.clip_range: float | th.Tensor = algorithm.value_of("clip_range")
        self.log_ratio_clamp: float | None = None
        self.surrogate_weights: th.Tensor | None = None
        self.trains_actor: bool = algorithm.n_rollouts >= algorithm.n_critic_warmup
        self.critic_rate: OwnRate | None = None
        if (rate := algorithm.critic_learning_rate_now()) is not None:
            self.critic_rate = OwnRate(frozenset(self.policy.critic_parameters()), rate)
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

    def minibatch_losses(
        self, minibatches: Minibatches, metrics: "UpdateMetrics"
    ) -> Iterator[tuple[Loss, th.Tensor]]:
        """Go through the minibatches of an epoch, see :meth:`loss`.

        :param minibatches: Minibatches, with what was drawn for them.
        :param metrics: Takes what is to be logged.
        """
        evaluate = self._prepared(minibatches)
        for part in minibatches.parts:
            compiled = None if evaluate is None else evaluate(part)
            if compiled is None:
                yield self.loss(minibatches.at(part), metrics)
            else:
                yield self._logged(compiled, metrics)

    def _prepared(self, minibatches: Minibatches) -> EvaluateRows | None:
        """What evaluates minibatches: a graph, or a kernel if no step changes their features."""
        recorded, samples = self.recorded_loss, minibatches.shuffled
        if recorded is not None:
            return lambda part: recorded(minibatches.at(part))
        is_known = self.compiled_loss is not None and type(self).loss is FlowUpdate.loss
        if samples is None or not is_known or not has_fixed_features(self.policy):
            return None
        features = self.policy.actor_critic_features(samples.observations)
        has_gradients = any(values.requires_grad for values in features)
        return None if has_gradients else self._compiled(samples, *features)

    def _compiled(
        self, samples: FlowRolloutBufferSamples, features: th.Tensor, critic_features: th.Tensor
    ) -> EvaluateRows | None:
        """What takes the place of the formulas, if anything can."""
        if self.compiled_loss is None or self.pull is not None:
            return None
        return self.compiled_loss(samples, features, critic_features)

    @staticmethod
    def _logged(compiled: EvaluatedTerms, metrics: "UpdateMetrics") -> tuple[Loss, th.Tensor]:
        metrics.add_means(compiled.means)
        metrics.add_maxima(compiled.maxima)
        return compiled.loss, compiled.kl

    def loss(
        self, batch: FlowRolloutBufferSamples, metrics: "UpdateMetrics"
    ) -> tuple[Loss, th.Tensor]:
        """The loss of a minibatch (paper, algorithm 1, lines 18 to 21).

        :param batch: n samples, with what was drawn for them.
        :param metrics: Takes what is to be logged.
        :return: The loss, and the divergence from the reference policy, without dimensions.
        """
        features, critic_features = self.policy.actor_critic_features(batch.observations)
        evaluate = self._compiled(batch, features, critic_features)
        if evaluate is not None and (compiled := evaluate(slice(None))) is not None:
            return self._logged(compiled, metrics)
        terms = self.terms(batch, features)  # lines 18, 20 and 21: ratio, regularizers
        if self.pull is not None:
            pull = self.pull.loss(batch, features)
            terms = terms._replace(
                regularizer=terms.regularizer + self.pull.coef * pull,
                metrics={**terms.metrics, "imitation_loss": pull},
            )
        unclamped = terms.log_ratio if terms.unclamped is None else terms.unclamped
        metrics.add_maxima({"log_ratio_max": unclamped.detach().abs().max()})
        policy_loss = self.surrogate_loss(terms.log_ratio, batch.advantages, metrics)  # line 19
        # Squared error of the values against the TD(lambda) returns
        values = self.policy.values(critic_features).flatten()
        value_loss = clipped_value_loss(values, batch.old_values, batch.returns, self.clip_range_vf)
        metrics.add_means({"value_loss": value_loss, **terms.metrics})
        return policy_loss + terms.regularizer + self.vf_coef * value_loss, terms.kl.detach()

    def surrogate_loss(
        self, log_ratio: th.Tensor, advantages: th.Tensor, metrics: "UpdateMetrics"
    ) -> th.Tensor:
        """The negative surrogate objective, which keeps the policy near the reference policy.

        :param log_ratio: log rho, shape (n, ...), with one entry for each surrogate.
        :param advantages: A, shape (n,).
        :param metrics: Takes the loss and what is to be logged of the ratios.
        :return: The mean over samples and surrogates, a tensor without dimensions.
        """
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
        self._to_average: dict[str, list[Any]] = {}
        self._to_maximize: dict[str, list[Any]] = {}

    def add_means(self, metrics: Metrics) -> None:
        """Add metrics of one minibatch, tensors without dimensions or numbers, to be averaged."""
        for name, value in metrics.items():
            self._append(self._to_average.setdefault(name, []), value)

    def add_maxima(self, metrics: Metrics) -> None:
        """Add metrics of one minibatch of which the greatest counts."""
        for name, value in metrics.items():
            self._append(self._to_maximize.setdefault(name, []), value)

    def last(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Those to average and those of which the greatest counts, as they were added last."""
        kinds = (self._to_average, self._to_maximize)
        means, maxima = ({name: values[-1] for name, values in kind.items()} for kind in kinds)
        return means, maxima

    @staticmethod
    def _append(values: list[Any], value: th.Tensor | float) -> None:
        values.append(value.detach() if isinstance(value, th.Tensor) else value)
        if len(values) == 32 and isinstance(value, th.Tensor):
            # Many small tensors would keep the memory between them from being used again.
            values[:] = [_joined(values)]

    def summary(self) -> dict[str, float]:
        """Each metric over all minibatches."""
        reduced = {name: _joined(values).mean() for name, values in self._to_average.items()}
        reduced |= {name: _joined(values).max() for name, values in self._to_maximize.items()}
        if not reduced:
            return {}
        return dict(zip(reduced, th.stack(list(reduced.values())).tolist(), strict=True))


def _joined(values: list[Any]) -> th.Tensor:
    """Tensors and numbers as one tensor."""
    numbers = [value for value in values if not isinstance(value, th.Tensor)]
    tensors = [value for value in values if isinstance(value, th.Tensor)]
    if numbers:
        tensors.append(th.tensor(numbers, dtype=th.float32, device="cpu"))
    return th.hstack(tensors)


def check_model(model: Any) -> None:
    """Refuse options that do not go together with each other or with the policy that was made.

    :param model: An algorithm that has its policy.
    :raises TypeError: If a critic is to be trained alone that cannot be told from the actor.
    """
    networks = model.policy.mlp_extractor
    tells_apart = {
        "n_critic_warmup": model.n_critic_warmup or None,
        "critic_learning_rate": model.critic_learning_rate,
    }
    given = [f"{name}={value}" for name, value in tells_apart.items() if value is not None]
    if given and not hasattr(networks, "value_net"):
        raise TypeError(
            f"{given[0]} needs to know which part of "
            f"{type(networks).__name__} is the critic's: make it a module named value_net, as in "
            "stable_baselines3.common.torch_layers.MlpExtractor."
        )
    for check in model.model_checks:
        check(model)


def check_cloned(model: Any) -> None:
    """Refuse a pull towards a policy that does not exist.

    :raises ValueError: If the model was not cloned from demonstrations.
    """
    if not is_zero(model.imitation_coef) and model.cloned_parameters is None:
        raise ValueError(
            f"imitation_coef={model.imitation_coef!r} pulls towards a policy that was cloned from "
            "demonstrations, and this model was not: call sb3_policyflow.imitation.clone first, or "
            "leave it out."
        )
