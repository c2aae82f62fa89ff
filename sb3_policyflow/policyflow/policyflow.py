"""PolicyFlow (paper, algorithm 1)."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_policyflow.common import checks
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.common.losses import (
    gaussian_entropy,
    gaussian_kl,
    shifted_gaussian_log_ratio,
)
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.names import policy_aliases
from sb3_policyflow.common.options import FORMER_DEFAULTS, FORMER_NAMES, shares_options
from sb3_policyflow.common.schedules import Coefficient, is_zero, parse_schedule
from sb3_policyflow.common.tree import in_chunks
from sb3_policyflow.common.update import FlowUpdate, PolicyTerms
from sb3_policyflow.flows import TIME_SAMPLERS
from sb3_policyflow.policyflow.compiled import make_compiled_loss
from sb3_policyflow.policyflow.policies import (
    CnnFlowPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
    PolicyFlowOptions,
    PolicyFlowPolicy,
)
from sb3_policyflow.policyflow.uniform import UniformTargets, check_regularizers


class PathSamples(NamedTuple):
    """Where velocities are compared, for n samples and k times each.

    Times t (n, k), points x_t (n, k, action_dim), and the velocity v-hat of the reference policy
    there (n, k, action_dim).
    """

    times: th.Tensor
    points: th.Tensor
    reference_velocity: th.Tensor


class PolicyFlowUpdate(FlowUpdate, may_be_recorded=True):
    """Algorithm 1 for one rollout: line 3, and in each epoch lines 15 to 18, 20 and 21.

    :param algorithm: The algorithm, whose policy has not been updated yet.
    :param rollout: The whole rollout of n samples.
    """

    policy: PolicyFlowPolicy

    def __init__(self, algorithm: "PolicyFlow", rollout: FlowRolloutBufferSamples) -> None:
        super().__init__(algorithm, rollout)
        policy = algorithm.policy
        self.flow = policy.flow
        self.latent_std = 1.0 if policy.gaussian else policy.latent_scale
        # Line 3: the reference policy, theta-hat and sigma-hat. Its features are extracted once.
        self.reference_field = deepcopy(policy.velocity)
        self.reference_log_std = policy.noise_log_std.detach().clone()
        self.reference_features = in_chunks(
            policy.actor_features, rollout.observations, self.batch_size
        )
        self.time_sampler = TIME_SAMPLERS[algorithm.time_sampler](self.flow.times())
        self.n_times = algorithm.n_times
        self.time_average = algorithm.time_average
        self.log_ratio_clamp = algorithm.log_ratio_clamp
        self.brownian_coef = algorithm.value_of("brownian_coef")  # w_b
        self.brownian_reduction = algorithm.brownian_reduction
        self.ent_coef = algorithm.value_of("ent_coef")  # w_g
        self.uniform_coef = algorithm.value_of("uniform_noise_coef")
        has_targets = not is_zero(algorithm.uniform_noise_coef)
        self.uniform_targets = UniformTargets.of(policy) if has_targets else None
        if type(self) is PolicyFlowUpdate:  # a subclass may have other formulas
            self.compiled_loss = make_compiled_loss(self)

    def draw(self) -> PathSamples:
        """Times and points for each sample, with the reference velocity there."""
        latents = self.rollout.record.latents.unsqueeze(1)
        endpoints = self.rollout.record.endpoints.unsqueeze(1)
        # Lines 15 and 16: t from the solver's time grid, or uniform.
        times = self.time_sampler.sample(len(latents), self.n_times)
        # Line 17: the interpolation points x_t.
        points = self.flow.interpolant.interpolate(latents, endpoints, times)
        inputs = points, times, self.reference_features.unsqueeze(1)
        velocity = in_chunks(lambda x: self.reference_field(*x), inputs, self.batch_size)
        return PathSamples(times, points, velocity)

    def terms(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> PolicyTerms:
        """Importance ratio and regularizers from the change of the velocity."""
        drawn: PathSamples = batch.drawn
        velocity = self.policy.velocity(drawn.points, drawn.times, features.unsqueeze(1))
        # Line 18: the log ratio of n = a - phi under noise that is shifted with the end point. On
        # an interpolant of length T, that is T times the mean change of the velocity.
        change = velocity - drawn.reference_velocity
        shift = self.flow.interpolant.end_time * change
        if self.time_average == "shift":
            shift = shift.mean(dim=1, keepdim=True)
        noise = (batch.actions - batch.record.endpoints).unsqueeze(1)
        log_std = self.policy.noise_log_std
        log_ratio = shifted_gaussian_log_ratio(noise, shift, log_std, self.reference_log_std)
        # Lines 20 and 21: the Brownian regularizer and the entropy of the noise. A term without
        # weight is logged, but needs no gradient.
        brownian_loss = self.brownian_loss(
            drawn, velocity if self.brownian_coef != 0 else velocity.detach()
        )
        entropy = gaussian_entropy(log_std)
        regularizer = self.brownian_coef * brownian_loss - self.ent_coef * entropy
        metrics = {"brownian_loss": brownian_loss, "entropy_loss": -entropy}
        if self.uniform_targets is not None:
            uniform_loss = self.uniform_targets.loss(self.policy.velocity, features)
            regularizer = regularizer + self.uniform_coef * uniform_loss
            metrics["uniform_noise_loss"] = uniform_loss
        metrics["velocity_change"] = change.detach().norm(dim=-1).mean()
        kl = gaussian_kl(shift.detach(), log_std.detach(), self.reference_log_std).mean()
        return PolicyTerms(log_ratio, kl, regularizer, metrics)

    def brownian_loss(self, drawn: PathSamples, velocity: th.Tensor) -> th.Tensor:
        """Mean over samples of ||eta||^2 (paper, J^Reg).

        :param drawn: Where velocities are compared.
        :param velocity: v there, shape (n, k, action_dim).
        """
        eta = self.flow.interpolant.brownian_residual(
            velocity, drawn.reference_velocity, drawn.points, drawn.times, self.latent_std
        )
        squares = eta.square()
        over_actions = squares.sum(-1) if self.brownian_reduction == "sum" else squares.mean(-1)
        return over_actions.mean()


class PolicyFlow(FlowOnPolicyAlgorithm):
    """On-policy learning with continuous-normalizing-flow policies.

    Paper: PolicyFlow: Policy Optimization with Continuous Normalizing Flow in Reinforcement
    Learning (ICLR 2026), https://arxiv.org/abs/2602.01156

    PPO's update, with an importance ratio of the Gaussian noise around a flow's end point. The
    shift of the end point is estimated from the change of the velocity at points between latent and
    end point. An entropy regularizer lets the flow spread as Brownian motion would.

    Takes the arguments of SB3's PPO with its names, order and defaults, those of
    :class:`~sb3_policyflow.common.algorithm.FlowOnPolicyAlgorithm`, the options of
    :class:`~sb3_policyflow.policyflow.PolicyFlowPolicy`, and:

    :param brownian_coef: w_b, weight of the Brownian regularizer: a constant, "lin_START",
        "lin_START_END" or a function of the remaining progress. ``ent_coef``, w_g, weighs the
        entropy of the Gaussian noise and takes the same forms.
    :param time_sampler: Times of the update: "grid" (the solver's own), "grid_without_end" or
        "uniform".
    :param n_times: Times for each sample.
    :param time_average: With several times, whether each has its own surrogate ("objective") or
        their mean shift makes one ("shift").
    :param brownian_reduction: "sum" over action dimensions, or their "mean".
    :param uniform_noise_coef: Weight of flow matching towards uniform actions, another entropy
        regularizer (Ding et al., 2024). Takes the forms of ``brownian_coef``.
    :param log_ratio_clamp: Log ratios beyond it have no gradient and do not overflow; None for no
        bound. ``train/log_ratio_max`` is the greatest one before the clamp.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base = PolicyFlowPolicy
    update_class = PolicyFlowUpdate
    policy: PolicyFlowPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = policy_aliases(
        MlpFlowPolicy, CnnFlowPolicy, MultiInputFlowPolicy
    )
    former_names: ClassVar[Mapping[str, str]] = {**FORMER_NAMES, "path": "interpolant"}
    former_defaults: ClassVar[Mapping[str, Any]] = {**FORMER_DEFAULTS, "n_flow_steps": 12}
    divergence_advice = ", or keep log_std_bounds of the noise away from zero"
    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "brownian_coef": parse_schedule,
        "time_sampler": checks.one_of(TIME_SAMPLERS),
        "n_times": checks.at_least(1),
        "time_average": checks.one_of(("objective", "shift")),
        "brownian_reduction": checks.one_of(("sum", "mean")),
        "uniform_noise_coef": parse_schedule,
        "log_ratio_clamp": checks.or_none(checks.positive),
    }
    model_checks = (check_regularizers,)

    @shares_options(FlowOnPolicyAlgorithm, PolicyFlowPolicy, former_names)
    def __init__(
        self,
        policy: str | type[PolicyFlowPolicy],
        env: GymEnv | str,
        *args: Any,
        brownian_coef: Coefficient = 0.0,
        time_sampler: str = "grid",
        n_times: int = 1,
        time_average: str = "objective",
        brownian_reduction: str = "sum",
        uniform_noise_coef: Coefficient = 0.0,
        log_ratio_clamp: float | None = None,
        **options: Unpack[PolicyFlowOptions],
    ) -> None:
        self.brownian_coef = brownian_coef
        self.time_sampler = time_sampler
        self.n_times = n_times
        self.time_average = time_average
        self.brownian_reduction = brownian_reduction
        self.uniform_noise_coef = uniform_noise_coef
        self.log_ratio_clamp = log_ratio_clamp
        super().__init__(policy, env, *args, **options)

    @property
    def n_evaluations_per_sample(self) -> int:
        """Evaluations of the velocity for one sample in one gradient step, with the reference's."""
        return 2 * self.n_times
