"""DPPO: PPO over the steps in which an action is denoised."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_policyflow.common import checks
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.common.entropy import ENTROPY_CHECKS, EntropyBonus
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.names import policy_aliases
from sb3_policyflow.common.options import FORMER_NAMES, shares_options
from sb3_policyflow.common.schedules import parse_schedule
from sb3_policyflow.common.update import FlowUpdate, PolicyTerms
from sb3_policyflow.dppo.policies import (
    CnnFlowPolicy,
    DPPOOptions,
    DPPOPolicy,
    DPPORecord,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
    warn_of_wide_bounds,
)


class DPPOUpdate(FlowUpdate, may_be_recorded=True):
    """DPPO's part of the update of one rollout, whose record has the reference policy's means.

    :param algorithm: The algorithm, whose policy has not been updated yet.
    :param rollout: The whole rollout of n samples.
    """

    policy: DPPOPolicy

    def __init__(self, algorithm: "DPPO", rollout: FlowRolloutBufferSamples) -> None:
        super().__init__(algorithm, rollout)
        self.log_prob_clamp = algorithm.log_prob_clamp
        self.log_prob_reduction = algorithm.log_prob_reduction
        self.entropy_bonus = EntropyBonus.of(algorithm)
        self.stds = self.policy.log_prob_stds
        n_steps = len(self.stds)
        like_stds: Any = {"device": self.stds.device, "dtype": self.stds.dtype}
        steps_left = th.arange(n_steps, **like_stds).flip(0)
        self.surrogate_weights = algorithm.denoising_gamma**steps_left
        if algorithm.clip_range_base is not None:
            # From 0 to 1 over the trained steps; a single step is a last one.
            position = th.linspace(1, 0, n_steps, **like_stds).flip(0)
            rate, base = algorithm.clip_range_rate, algorithm.clip_range_base
            rise = th.expm1(rate * position) / math.expm1(rate)
            self.clip_range = base + (self.clip_range - base) * rise

    def draw(self) -> tuple[()]:
        """Nothing: every epoch evaluates all trained steps."""
        return ()

    def terms(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> PolicyTerms:
        """Ratios of the trained denoising steps (DPPO, policy gradient of the two-layer MDP)."""
        record: DPPORecord = batch.record
        means = self.policy.trained_means(record.points[:, :-1], features)
        log_ratio = self.log_probs(record, means) - self.log_probs(record, record.means)
        # The divergence of the chains, given the points at which their steps start
        change = (means - record.means) / self.stds.unsqueeze(-1)
        kl = 0.5 * change.square().sum(dim=(-2, -1)).mean()
        # Entropy of the actions, from samples
        regularizer, metrics = self.entropy_bonus.regularizer(self.policy, features)
        return PolicyTerms(log_ratio, kl, regularizer, metrics)

    def log_probs(self, record: DPPORecord, means: th.Tensor) -> th.Tensor:
        """Log likelihoods of the trained steps around some means, shape (n, k).

        :param record: The steps.
        :param means: Shape (n, k, action_dim).
        """
        stds = self.stds.unsqueeze(-1)
        energy = 0.5 * ((record.points[:, 1:] - means) / stds).square()
        log_probs = -energy - stds.log() - 0.5 * math.log(2 * math.pi)
        if self.log_prob_clamp is not None:
            log_probs = log_probs.clamp(*self.log_prob_clamp)
        return log_probs.sum(-1) if self.log_prob_reduction == "sum" else log_probs.mean(-1)


def check_clip_ranges(model: Any) -> None:
    """Refuse a clip range that would fall from the first trained step to the last.

    :param model: A DPPO.
    :raises ValueError: If the first one is the greater.
    """
    base, last = model.clip_range_base, parse_schedule("clip_range", model.clip_range)(1.0)
    if base is not None and base > last:
        raise ValueError(
            f"clip_range_base={base!r} is the clip range of the first trained step, from which it "
            f"rises to clip_range={last:g}: give a smaller one, or None for the same in each."
        )


class DPPO(FlowOnPolicyAlgorithm):
    """On-policy learning with diffusion policies.

    Paper: Diffusion Policy Policy Optimization, https://arxiv.org/abs/2409.00588

    PPO's update with one importance ratio for each denoising step, whose likelihood is Gaussian.
    The papers of FPO and PolicyFlow compare with a variant under this name: ``process="flow"``,
    ``noise_clip=None``, ``log_prob_clamp=None``, ``log_prob_reduction="sum"``,
    ``denoising_gamma=1``, and 0.05 for both least standard deviations.

    Takes the arguments of SB3's PPO with its names, order and defaults, those of
    :class:`~sb3_policyflow.common.algorithm.FlowOnPolicyAlgorithm`, the options of
    :class:`~sb3_policyflow.dppo.DPPOPolicy`, and:

    :param log_prob_clamp: Bounds of log likelihoods, in each dimension; None for no bounds.
    :param log_prob_reduction: "mean" over action dimensions, or their "sum".
    :param denoising_gamma: Discount per denoising step: the step j before the last has the weight
        ``denoising_gamma**j``.
    :param clip_range_base: Clip range of the first trained step, from which that of the others
        rises to ``clip_range`` exponentially; None for the same in each.
    :param clip_range_rate: Rate of this exponential.
    :param n_entropy_actions: Actions drawn in a state for the entropy that ``ent_coef`` weighs.
    :param n_entropy_states: States of a minibatch in which they are drawn, at most.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base = DPPOPolicy
    update_class = DPPOUpdate
    policy: DPPOPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = policy_aliases(
        MlpFlowPolicy, CnnFlowPolicy, MultiInputFlowPolicy
    )
    divergence_advice = ", or raise min_log_prob_std"
    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "log_prob_clamp": checks.or_none(checks.bounds),
        "log_prob_reduction": checks.one_of(("mean", "sum")),
        "denoising_gamma": checks.positive_up_to(1.0),
        "clip_range_base": checks.or_none(checks.positive),
        "clip_range_rate": checks.positive,
        **ENTROPY_CHECKS,
    }
    model_checks = (check_clip_ranges,)

    @shares_options(FlowOnPolicyAlgorithm, DPPOPolicy, FORMER_NAMES)
    def __init__(
        self,
        policy: str | type[DPPOPolicy],
        env: GymEnv | str,
        *args: Any,
        log_prob_clamp: tuple[float, float] | None = (-5.0, 2.0),
        log_prob_reduction: str = "mean",
        denoising_gamma: float = 0.99,
        clip_range_base: float | None = None,
        clip_range_rate: float = 3.0,
        n_entropy_actions: int = 8,
        n_entropy_states: int = 256,
        **options: Unpack[DPPOOptions],
    ) -> None:
        self.log_prob_clamp = log_prob_clamp
        self.log_prob_reduction = log_prob_reduction
        self.denoising_gamma = denoising_gamma
        self.clip_range_base = clip_range_base
        self.clip_range_rate = clip_range_rate
        self.n_entropy_actions = n_entropy_actions
        self.n_entropy_states = n_entropy_states
        super().__init__(policy, env, *args, **options)
        if hasattr(self, "policy"):  # not while a file is loaded
            warn_of_wide_bounds(self.policy)

    @property
    def n_evaluations_per_sample(self) -> int:
        """Evaluations of the network for one sample in one gradient step."""
        return len(self.policy.log_prob_stds)
