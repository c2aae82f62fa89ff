"""FPO: PPO with the change of a flow-matching loss in place of that of a likelihood."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_policyflow.common import checks
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.common.entropy import ENTROPY_CHECKS, EntropyBonus
from sb3_policyflow.common.losses import SURROGATES, ratio_divergence
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.names import policy_aliases
from sb3_policyflow.common.options import FORMER_NAMES, shares_options
from sb3_policyflow.common.tree import in_chunks
from sb3_policyflow.common.update import FlowUpdate, PolicyTerms
from sb3_policyflow.flows import TIME_SAMPLERS
from sb3_policyflow.fpo.policies import (
    CnnFlowPolicy,
    FPOOptions,
    FPOPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
)


class MonteCarloSamples(NamedTuple):
    """Where flow-matching losses are compared, for n samples of the rollout and k draws each.

    Times t (n, k), noises eps (n, k, action_dim), and the losses of the reference policy (n, k).
    """

    times: th.Tensor
    noises: th.Tensor
    reference_losses: th.Tensor


class FPOUpdate(FlowUpdate, may_be_recorded=True):
    """FPO's part of the update of one rollout.

    Times and noises are drawn here and not when acting. They are the same in distribution, because
    parameters do not change during a rollout, and cost ``predict`` and the buffer nothing.

    :param algorithm: The algorithm, whose policy has not been updated yet.
    :param rollout: The whole rollout of n samples.
    """

    policy: FPOPolicy

    def __init__(self, algorithm: "FPO", rollout: FlowRolloutBufferSamples) -> None:
        super().__init__(algorithm, rollout)
        policy = algorithm.policy
        self.algorithm = algorithm
        self.entropy_bonus = EntropyBonus.of(algorithm)
        n_samples, action_dim = rollout.actions.shape
        sampler = TIME_SAMPLERS[algorithm.time_sampler](policy.flow.times())
        times = sampler.sample(n_samples, algorithm.n_mc_samples)
        noises = th.randn(*times.shape, action_dim, device=times.device, dtype=times.dtype)
        drawn = MonteCarloSamples(times, noises, times.new_empty(times.shape))
        losses = in_chunks(
            lambda part: self.losses(part, policy.actor_features(part.observations)),
            rollout._replace(drawn=drawn),
            self.batch_size,
        )
        self.drawn = drawn._replace(reference_losses=losses)

    def draw(self) -> MonteCarloSamples:
        """The same samples in every epoch."""
        return self.drawn

    def losses(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> th.Tensor:
        """Flow-matching losses of the actions at their times and noises, shape (n, k).

        The noise that a velocity v stands for is x_t - t v: its error is t times the velocity's.

        :param batch: n samples, with what was drawn for them.
        :param features: The actor's features, shape (n, features_dim).
        """
        times, noises, _ = batch.drawn
        actions = batch.actions.unsqueeze(1)
        points = self.policy.flow.interpolant.interpolate(noises, actions, times)
        velocity: th.Tensor = self.policy.velocity(points, times, features.unsqueeze(1))
        error = velocity - (actions - noises)
        if self.algorithm.loss_target == "epsilon":
            error = times.unsqueeze(-1) * error
        squares = error.square()
        sums = self.algorithm.loss_reduction == "sum"
        losses: th.Tensor = squares.sum(-1) if sums else squares.mean(-1)
        clamp = self.algorithm.loss_clamp
        return losses if clamp is None else losses.clamp(max=clamp)

    def terms(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> PolicyTerms:
        """Ratio from the change of the flow-matching loss (FPO, equation of the ratio)."""
        losses = self.losses(batch, features)
        change, clamp = batch.drawn.reference_losses - losses, self.algorithm.difference_clamp
        log_ratio = self._averaged(change if clamp is None else change.clamp(-clamp, clamp))
        unclamped = None if clamp is None else self._averaged(change.detach())
        # Entropy of the actions, from samples
        regularizer, metrics = self.entropy_bonus.regularizer(self.policy, features)
        metrics["flow_matching_loss"] = losses.mean()
        kl = ratio_divergence(log_ratio)
        return PolicyTerms(log_ratio, kl, regularizer, metrics, unclamped)

    def _averaged(self, changes: th.Tensor) -> th.Tensor:
        """Log ratios (n, ...) from changes of the losses (n, k)."""
        return changes.mean(dim=1) if self.algorithm.mc_average == "loss" else changes


class FPO(FlowOnPolicyAlgorithm):
    """On-policy learning with flow policies and flow-matching losses.

    Papers: Flow Matching Policy Gradients, https://arxiv.org/abs/2507.21053; for FPO++,
    Flow Policy Gradients for Robot Control, https://arxiv.org/abs/2602.02481

    PPO's update with exp(reference loss - new loss) as its ratio. The loss is that of flow matching
    towards the action that was taken, at random noises and times.

    Time runs from 0 (noise) to 1 (action), against FPO's own: t = 1 - tau, and v = -u.

    Takes the arguments of SB3's PPO with its names and order and, except for ``clip_range``, with
    its defaults, those of :class:`~sb3_policyflow.common.algorithm.FlowOnPolicyAlgorithm`, the
    options of :class:`~sb3_policyflow.fpo.FPOPolicy`, and:

    :param n_mc_samples: N_mc, Monte Carlo samples of noise and time for each action.
    :param mc_average: Whether the mean change of the "loss" over the samples makes one ratio, or
        each sample makes its own and the "objective" is averaged (FPO++).
    :param loss_target: Whether the loss compares "epsilon", the noise, or the "velocity" (FPO++).
    :param loss_reduction: "mean" over action dimensions, or their "sum" (FPO++).
    :param time_sampler: Times of the samples: "grid_without_end" (where Euler's steps start),
        "grid" (the same with the end) or "uniform".
    :param trust_region: "ppo" clips, "spo" penalizes changes quadratically, and "aspo" (FPO++)
        clips for positive advantages and penalizes for negative ones.
    :param loss_clamp: Greatest loss of a sample; None for no bound.
    :param difference_clamp: Greatest change of a sample's loss; None for no bound.
        ``train/log_ratio_max`` is the greatest log ratio before the clamp.
    :param n_entropy_actions: Actions drawn in a state for the entropy that ``ent_coef`` weighs.
    :param n_entropy_states: States of a minibatch in which they are drawn, at most.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base = FPOPolicy
    update_class = FPOUpdate
    policy: FPOPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = policy_aliases(
        MlpFlowPolicy, CnnFlowPolicy, MultiInputFlowPolicy
    )
    former_names: ClassVar[Mapping[str, str]] = {
        **FORMER_NAMES,
        "n_probes": "n_mc_samples",
        "probe_average": "mc_average",
    }
    divergence_advice = ", or set difference_clamp"
    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "n_mc_samples": checks.at_least(1),
        "mc_average": checks.one_of(("loss", "objective")),
        "loss_target": checks.one_of(("epsilon", "velocity")),
        "loss_reduction": checks.one_of(("mean", "sum")),
        "time_sampler": checks.one_of(TIME_SAMPLERS),
        "trust_region": checks.one_of(SURROGATES),
        "loss_clamp": checks.or_none(checks.positive),
        "difference_clamp": checks.or_none(checks.positive),
        **ENTROPY_CHECKS,
    }

    # The ratio is that of an average over samples, and moves less than a likelihood's.
    @shares_options(FlowOnPolicyAlgorithm, FPOPolicy, former_names, clip_range=0.05)
    def __init__(
        self,
        policy: str | type[FPOPolicy],
        env: GymEnv | str,
        *args: Any,
        n_mc_samples: int = 8,
        mc_average: str = "loss",
        loss_target: str = "epsilon",
        loss_reduction: str = "mean",
        time_sampler: str = "grid_without_end",
        trust_region: str = "ppo",
        loss_clamp: float | None = None,
        difference_clamp: float | None = None,
        n_entropy_actions: int = 8,
        n_entropy_states: int = 256,
        **options: Unpack[FPOOptions],
    ) -> None:
        self.n_mc_samples = n_mc_samples
        self.mc_average = mc_average
        self.loss_target = loss_target
        self.loss_reduction = loss_reduction
        self.time_sampler = time_sampler
        self.trust_region = trust_region
        self.loss_clamp = loss_clamp
        self.difference_clamp = difference_clamp
        self.n_entropy_actions = n_entropy_actions
        self.n_entropy_states = n_entropy_states
        super().__init__(policy, env, *args, **options)

    @property
    def n_evaluations_per_sample(self) -> int:
        """Evaluations of the velocity for one sample in one gradient step."""
        return self.n_mc_samples
