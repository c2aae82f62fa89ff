"""FPO: PPO with the change of a flow-matching loss in place of that of a likelihood."""

from typing import Any, ClassVar, NamedTuple, TypeVar

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_policyflow.common import checks
from sb3_policyflow.common.aliases import flow_policy_aliases
from sb3_policyflow.common.chunks import in_chunks
from sb3_policyflow.common.entropy import SampledEntropyMixin
from sb3_policyflow.common.losses import SURROGATES, ratio_divergence
from sb3_policyflow.common.schedules import Coefficient
from sb3_policyflow.common.type_aliases import FlowRolloutBufferSamples, PolicyTerms
from sb3_policyflow.flows import TIME_SAMPLERS
from sb3_policyflow.fpo.policies import (
    CnnFlowPolicy,
    FPOPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
)

SelfFPO = TypeVar("SelfFPO", bound="FPO")


class Probes(NamedTuple):
    """Where new and old flow-matching losses are compared, for n samples and k probes each.

    Times t (n, k), noises eps (n, k, action_dim), and the old losses (n, k).
    """

    times: th.Tensor
    noises: th.Tensor
    losses: th.Tensor


class FPO(SampledEntropyMixin):
    """On-policy learning with flow policies and flow-matching losses.

    Papers: Flow Matching Policy Gradients, https://arxiv.org/abs/2507.21053; for FPO++,
    Flow Policy Gradients for Robot Control, https://arxiv.org/abs/2602.02481

    PPO's update with exp(old loss - new loss) as its ratio, where the loss is that of flow
    matching towards the action that was taken, at k random noises and times.

    Time runs from 0 (noise) to 1 (action), against FPO's own: t = 1 - tau, and v = -u.

    Takes the arguments of SB3's PPO with its names and order and, except for ``clip_range``, with
    its defaults, those of :class:`~sb3_policyflow.common.arguments.FlowAlgorithmArguments`, and:

    :param n_probes: k, noises and times for each action.
    :param probe_average: Whether the mean change of the "loss" over the probes makes one ratio, or
        each probe makes its own and the "objective" is averaged (FPO++).
    :param loss_target: Whether the loss compares "epsilon", the noise, or the "velocity" (FPO++).
    :param loss_reduction: "mean" over action dimensions, or their "sum" (FPO++).
    :param time_sampler: Times of the probes: "starts" of Euler's steps, "grid" (the same with the
        end) or "uniform".
    :param trust_region: "ppo" clips, "spo" penalizes changes quadratically, and "aspo" (FPO++)
        clips for positive advantages and penalizes for negative ones.
    :param loss_clamp: Greatest loss of a probe; None for none.
    :param difference_clamp: Greatest change of a probe's loss; None for none.
    :param n_flow_steps: Solver steps from noise to action.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param action_noise_std: Standard deviation of Gaussian noise on top of the flow's end.
    :param n_entropy_actions: Actions drawn in a state for the entropy that ``ent_coef`` weighs.
    :param n_entropy_states: States of a minibatch in which they are drawn, at most.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base = FPOPolicy
    policy: FPOPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = flow_policy_aliases(
        MlpFlowPolicy, CnnFlowPolicy, MultiInputFlowPolicy
    )
    policy_arguments = ("n_flow_steps", "solver", "action_noise_std")
    divergence_advice = ", or set difference_clamp"

    def __init__(
        self,
        policy: str | type[FPOPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.05,
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
        n_probes: int = 8,
        probe_average: str = "loss",
        loss_target: str = "epsilon",
        loss_reduction: str = "mean",
        time_sampler: str = "starts",
        trust_region: str = "ppo",
        loss_clamp: float | None = None,
        difference_clamp: float | None = None,
        n_flow_steps: int = 10,
        solver: str = "euler",
        action_noise_std: float = 0.0,
        n_entropy_actions: int = 8,
        n_entropy_states: int = 256,
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
        self.n_probes = n_probes
        self.probe_average = probe_average
        self.loss_target = loss_target
        self.loss_reduction = loss_reduction
        self.time_sampler = time_sampler
        self.trust_region = trust_region
        self.loss_clamp = loss_clamp
        self.difference_clamp = difference_clamp
        self.n_flow_steps = n_flow_steps
        self.solver = solver
        self.action_noise_std = action_noise_std
        self.n_entropy_actions = n_entropy_actions
        self.n_entropy_states = n_entropy_states
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        checks.check_count("n_probes", self.n_probes, 1)
        checks.check_choice("probe_average", self.probe_average, ("loss", "objective"))
        checks.check_choice("loss_target", self.loss_target, ("epsilon", "velocity"))
        checks.check_choice("loss_reduction", self.loss_reduction, ("mean", "sum"))
        checks.check_choice("time_sampler", self.time_sampler, TIME_SAMPLERS)
        checks.check_choice("trust_region", self.trust_region, SURROGATES)
        checks.check_positive_or_none("loss_clamp", self.loss_clamp)
        checks.check_positive_or_none("difference_clamp", self.difference_clamp)

    def _setup_schedules(self) -> None:
        super()._setup_schedules()
        self._times = TIME_SAMPLERS[self.time_sampler](self.policy.solver_times())

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_times"]

    def _behavior(self, rollout: FlowRolloutBufferSamples) -> Probes:
        """Draw the probes and take their losses, with the weights that made the rollout.

        Drawn here and not when acting, they are the same in distribution, because weights do not
        change during a rollout; and they burden neither ``predict`` nor the buffer, and are
        evaluated in few large batches.
        """
        n_samples, action_dim = rollout.actions.shape
        times = self._times.sample(n_samples, self.n_probes)
        noises = th.randn(*times.shape, action_dim, device=times.device)
        unknown = times.new_empty(times.shape)
        drawn = rollout._replace(probes=Probes(times, noises, unknown))
        return Probes(times, noises, in_chunks(self._old_losses, drawn))

    def _draw_probes(self, rollout: FlowRolloutBufferSamples, behavior: Probes) -> Probes:  # noqa: ARG002
        """The same probes in every epoch."""
        return behavior

    def _old_losses(self, samples: FlowRolloutBufferSamples) -> th.Tensor:
        return self._losses(samples, self.policy.actor_features(samples.observations))

    def _losses(self, samples: FlowRolloutBufferSamples, features: th.Tensor) -> th.Tensor:
        """Flow-matching losses of the actions at their probes, shape (n, k).

        The noise that the velocity stands for is x_t - t v: its error is t times the velocity's.
        """
        probes: Probes = samples.probes
        times, noises, _ = probes
        actions = samples.actions.unsqueeze(1)
        points = self.policy.path.interpolate(noises, actions, times)
        velocity: th.Tensor = self.policy.velocity(points, times, features.unsqueeze(1))
        error = velocity - (actions - noises)
        if self.loss_target == "epsilon":
            error = times.unsqueeze(-1) * error
        squares = error.square()
        losses = squares.sum(-1) if self.loss_reduction == "sum" else squares.mean(-1)
        return losses if self.loss_clamp is None else losses.clamp(max=self.loss_clamp)

    def _policy_terms(
        self,
        batch: FlowRolloutBufferSamples,
        features: th.Tensor,
        behavior: Probes,  # noqa: ARG002  # the probes of the minibatch came with it
    ) -> PolicyTerms:
        """Ratio from the change of the flow-matching loss (FPO, equation of the ratio)."""
        losses = self._losses(batch, features)
        log_ratio = batch.probes.losses - losses
        if self.difference_clamp is not None:
            log_ratio = log_ratio.clamp(-self.difference_clamp, self.difference_clamp)
        if self.probe_average == "loss":
            log_ratio = log_ratio.mean(dim=1)
        regularizer, figures = self._entropy_bonus(features)
        return PolicyTerms(
            log_ratio=log_ratio,
            kl=ratio_divergence(log_ratio),
            regularizer=regularizer,
            metrics={**figures, "flow_matching_loss": losses.mean()},
        )

    def learn(
        self: SelfFPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "FPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfFPO:
        """Train for ``total_timesteps``; see SB3."""
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )
