"""PolicyFlow (paper, algorithm 1)."""

from typing import Any, ClassVar, NamedTuple, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_policyflow.common import checks
from sb3_policyflow.common.aliases import flow_policy_aliases
from sb3_policyflow.common.chunks import in_chunks
from sb3_policyflow.common.losses import (
    gaussian_entropy,
    gaussian_kl,
    shifted_gaussian_log_ratio,
)
from sb3_policyflow.common.on_policy_algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.common.schedules import Coefficient, parse_schedule
from sb3_policyflow.common.type_aliases import FlowRolloutBufferSamples, PolicyTerms
from sb3_policyflow.flows import TIME_SAMPLERS
from sb3_policyflow.policyflow.behavior import Behavior
from sb3_policyflow.policyflow.policies import (
    CnnFlowPolicy,
    FlowPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
    PolicyFlowRecord,
)
from sb3_policyflow.policyflow.uniform import UniformTargets

SelfPolicyFlow = TypeVar("SelfPolicyFlow", bound="PolicyFlow")


class Probes(NamedTuple):
    """Where an epoch compares new and old velocities, for n samples and k times each.

    Times t (n, k), points x_t (n, k, action_dim), and the old velocity there (n, k, action_dim).
    """

    times: th.Tensor
    points: th.Tensor
    old_velocity: th.Tensor


class PolicyFlow(FlowOnPolicyAlgorithm):
    """On-policy learning with continuous-normalizing-flow policies.

    Paper: PolicyFlow: Policy Optimization with Continuous Normalizing Flow in Reinforcement
    Learning (ICLR 2026), https://arxiv.org/abs/2602.01156

    PPO's update with the importance ratio of the Gaussian noise around a flow's end point, which
    is taken to shift by the change of the velocity between latent and end point, and with an
    entropy regularizer that lets the flow spread as Brownian motion would.

    Takes the arguments of SB3's PPO with its names, order and defaults, those of
    :class:`~sb3_policyflow.common.arguments.FlowAlgorithmArguments`, and:

    :param brownian_coef: w_b, weight of the Brownian regularizer: a constant, "lin_START",
        "lin_START_END" or a function of the remaining progress. ``ent_coef``, w_g, weighs the
        entropy of the Gaussian noise and takes the same forms.
    :param path: Interpolation path: "rectified", "stochastic", "stochastic_exact" or "trigflow". In
        ``load``, whose file is a ``path`` too, change it by ``custom_objects={"path": ...}``.
    :param time_sampler: Times of the update: "grid" (the solver's own), "starts" (the same without
        the end) or "uniform".
    :param n_times: Times for each sample.
    :param time_average: With several times, whether each has its own surrogate ("objective") or
        their mean shift makes one ("shift").
    :param n_flow_steps: Solver steps from latent to action.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param brownian_reduction: "sum" over action dimensions, or their "mean".
    :param gaussian: Whether the latents are always 0, which leaves a Gaussian policy. With
        ``solver="euler"``, ``n_flow_steps=1`` and ``time_sampler="starts"`` it is PPO's, exactly.
    :param uniform_noise_coef: Weight of flow matching towards uniform actions, another entropy
        regularizer (Ding et al., 2024). Takes the forms of ``brownian_coef``.
    :param log_ratio_clamp: Greatest absolute log ratio that learns; beyond it there is no gradient
        and no overflow. None for none. ``train/log_ratio_max`` tells what it was before.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base = FlowPolicy
    policy: FlowPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = flow_policy_aliases(
        MlpFlowPolicy, CnnFlowPolicy, MultiInputFlowPolicy
    )
    policy_arguments = ("path", "n_flow_steps", "solver", "gaussian")
    divergence_advice = ", or keep log_std_bounds of the noise away from zero"

    def __init__(
        self,
        policy: str | type[FlowPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: Coefficient = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float | None = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        brownian_coef: Coefficient = 0.0,
        path: str = "rectified",
        time_sampler: str = "grid",
        n_times: int = 1,
        time_average: str = "objective",
        n_flow_steps: int = 12,
        solver: str = "midpoint",
        brownian_reduction: str = "sum",
        gaussian: bool = False,
        uniform_noise_coef: Coefficient = 0.0,
        log_ratio_clamp: float | None = None,
        desired_kl: Coefficient | None = None,
        lr_adaptation: str = "epoch",
        lr_factor: float = 1.5,
        lr_bounds: tuple[float, float] = (1e-6, 1e-2),
        kl_margin: float = 2.0,
        kl_window: str = "epoch",
        advantage_scope: str = "minibatch",
        timeout_bootstrap: str = "terminal",
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
            desired_kl=desired_kl,
            lr_adaptation=lr_adaptation,
            lr_factor=lr_factor,
            lr_bounds=lr_bounds,
            kl_margin=kl_margin,
            kl_window=kl_window,
            advantage_scope=advantage_scope,
            timeout_bootstrap=timeout_bootstrap,
        )
        self.brownian_coef = brownian_coef
        self.path = path
        self.time_sampler = time_sampler
        self.n_times = n_times
        self.time_average = time_average
        self.n_flow_steps = n_flow_steps
        self.solver = solver
        self.brownian_reduction = brownian_reduction
        self.gaussian = gaussian
        self.uniform_noise_coef = uniform_noise_coef
        self.log_ratio_clamp = log_ratio_clamp
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        checks.check_choice("time_sampler", self.time_sampler, TIME_SAMPLERS)
        checks.check_count("n_times", self.n_times, 1)
        checks.check_choice("time_average", self.time_average, ("objective", "shift"))
        checks.check_choice("brownian_reduction", self.brownian_reduction, ("sum", "mean"))
        checks.check_positive_or_none("log_ratio_clamp", self.log_ratio_clamp)
        if self.gaussian and (self.brownian_coef, self.uniform_noise_coef) != (0.0, 0.0):
            raise ValueError(
                "A Gaussian policy has no flow to spread: with gaussian=True leave brownian_coef "
                "and uniform_noise_coef at 0, and use ent_coef."
            )

    def _setup_schedules(self) -> None:
        super()._setup_schedules()
        self._brownian_schedule = parse_schedule("brownian_coef", self.brownian_coef)
        self._times = TIME_SAMPLERS[self.time_sampler](self.policy.solver_times())
        self._uniform_schedule = parse_schedule("uniform_noise_coef", self.uniform_noise_coef)
        self._uniform: UniformTargets | None = None
        if self.uniform_noise_coef != 0.0:
            assert isinstance(self.action_space, spaces.Box)
            self._uniform = UniformTargets(
                self.action_space, self.policy.path, self.policy.latent_std
            )

    def _excluded_save_params(self) -> list[str]:
        derived = ["_brownian_schedule", "_uniform_schedule", "_uniform", "_times"]
        return [*super()._excluded_save_params(), *derived]

    def _behavior(self, rollout: FlowRolloutBufferSamples) -> Behavior:
        """The policy before the update, theta-hat and sigma-hat."""
        features = in_chunks(self.policy.actor_features, rollout.observations)
        return Behavior(self.policy, features)

    def _draw_probes(self, rollout: FlowRolloutBufferSamples, behavior: Behavior) -> Probes:
        """Draw t for each sample and look up the old velocity at x_t."""
        record: PolicyFlowRecord = rollout.record
        times = self._times.sample(len(rollout.actions), self.n_times)
        latents, endpoints = record.latents.unsqueeze(1), record.endpoints.unsqueeze(1)
        points = self.policy.path.interpolate(latents, endpoints, times)
        return Probes(times, points, behavior.velocity(points, times))

    def _policy_terms(
        self, batch: FlowRolloutBufferSamples, features: th.Tensor, behavior: Behavior
    ) -> PolicyTerms:
        """Ratio and regularizers from the change of the velocity (paper, ratio and J^Reg)."""
        probes: Probes = batch.probes
        velocity = self.policy.velocity(probes.points, probes.times, features.unsqueeze(1))
        change = velocity - probes.old_velocity
        # On a path of length T, the end point shifts by T times the mean change.
        shift = self.policy.path.end_time * change
        if self.time_average == "shift":
            shift = shift.mean(dim=1, keepdim=True)
        noise = (batch.actions - batch.record.endpoints).unsqueeze(1)
        log_std, old_log_std = self.policy.noise_log_std, behavior.log_std
        log_ratio = shifted_gaussian_log_ratio(noise, shift, log_std, old_log_std)
        regularizer, figures = self._regularizer(probes, velocity, features)
        if self.log_ratio_clamp is not None:
            figures["log_ratio_max"] = log_ratio.detach().abs().max()
            log_ratio = log_ratio.clamp(-self.log_ratio_clamp, self.log_ratio_clamp)
        return PolicyTerms(
            log_ratio=log_ratio,
            kl=gaussian_kl(shift.detach(), log_std.detach(), old_log_std).mean(),
            regularizer=regularizer,
            metrics={**figures, "velocity_change": change.detach().norm(dim=-1).mean()},
        )

    def _regularizer(
        self, probes: Probes, velocity: th.Tensor, features: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """What keeps the policy from becoming narrow, and its parts to log."""
        brownian_coef = self._now(self._brownian_schedule)
        ent_coef = self._now(self._entropy_schedule)
        # What has no weight is looked at, but needs no gradient.
        brownian_loss = self._brownian_loss(
            probes, velocity if brownian_coef != 0 else velocity.detach()
        )
        entropy = gaussian_entropy(self.policy.noise_log_std)
        regularizer = brownian_coef * brownian_loss - ent_coef * entropy
        figures = {"brownian_loss": brownian_loss, "entropy_loss": -entropy}
        if self._uniform is not None:
            uniform_loss = self._uniform.loss(self.policy.velocity, features)
            regularizer = regularizer + self._now(self._uniform_schedule) * uniform_loss
            figures["uniform_noise_loss"] = uniform_loss
        return regularizer, figures

    def _brownian_loss(self, probes: Probes, velocity: th.Tensor) -> th.Tensor:
        """Mean over samples of ||eta||^2 (paper, J^Reg)."""
        eta = self.policy.path.brownian_residual(
            velocity, probes.old_velocity, probes.points, probes.times, self.policy.latent_std
        )
        squares = eta.square()
        over_actions = squares.sum(-1) if self.brownian_reduction == "sum" else squares.mean(-1)
        return over_actions.mean()

    def _log_policy(self) -> None:
        self.logger.record("train/std", self.policy.noise_log_std.exp().mean().item())

    def learn(
        self: SelfPolicyFlow,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "PolicyFlow",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPolicyFlow:
        """Train for ``total_timesteps``; see SB3."""
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )
