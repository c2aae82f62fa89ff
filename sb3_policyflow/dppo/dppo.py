"""DPPO: PPO over the steps in which an action is denoised."""

import math
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_policyflow.common import checks
from sb3_policyflow.common.aliases import flow_policy_aliases
from sb3_policyflow.common.entropy import SampledEntropyMixin
from sb3_policyflow.common.schedules import Coefficient
from sb3_policyflow.common.type_aliases import FlowRolloutBufferSamples, PolicyTerms
from sb3_policyflow.dppo.policies import (
    CnnFlowPolicy,
    DPPOPolicy,
    DPPORecord,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
)

SelfDPPO = TypeVar("SelfDPPO", bound="DPPO")


class DPPO(SampledEntropyMixin):
    """On-policy learning with diffusion policies.

    Paper: Diffusion Policy Policy Optimization, https://arxiv.org/abs/2409.00588

    PPO's update with one importance ratio for each denoising step, whose likelihood is Gaussian.
    With ``process="flow"``, ``noise_clip=None``, ``log_prob_clamp=None``,
    ``log_prob_reduction="sum"``, ``denoising_gamma=1`` and both stds 0.05, it is what the papers of
    FPO and PolicyFlow compare with under this name.

    Takes the arguments of SB3's PPO with its names, order and defaults, those of
    :class:`~sb3_policyflow.common.arguments.FlowAlgorithmArguments`, and:

    :param process: "ddpm", or "flow" for Euler steps with noise of a fixed standard deviation.
    :param n_denoising_steps: K, steps from noise to action.
    :param n_finetuned_steps: How many of them, the last ones, are trained; the others belong to a
        frozen copy of the actor's networks. All if None.
    :param min_sampling_std: Least standard deviation of a step.
    :param min_log_prob_std: Least standard deviation that the likelihood of a step is taken with.
    :param noise_clip: Bound of a step's noise, in its standard deviations; None for none.
    :param denoised_clip: Bound of the action that "ddpm" predicts in each step.
    :param identity_skip: Whether "ddpm" adds the point to the network's output in predicting its
        noise, which keeps untrained policies off the bounds of the actions.
    :param log_prob_clamp: Bounds of log likelihoods, in each dimension; None for none.
    :param log_prob_reduction: "mean" over action dimensions, or their "sum".
    :param denoising_gamma: Weight of a denoising step relative to the one behind it.
    :param clip_range_base: Clip range of the first trained step, from which that of the others
        rises to ``clip_range`` exponentially; None for the same in each.
    :param clip_range_rate: How steeply it rises.
    :param n_critic_warmup: Rollouts at the start from which only the critic learns.
    :param n_entropy_actions: Actions drawn in a state for the entropy that ``ent_coef`` weighs.
    :param n_entropy_states: States of a minibatch in which they are drawn, at most.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base = DPPOPolicy
    policy: DPPOPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = flow_policy_aliases(
        MlpFlowPolicy, CnnFlowPolicy, MultiInputFlowPolicy
    )
    policy_arguments = (
        "process",
        "n_denoising_steps",
        "n_finetuned_steps",
        "min_sampling_std",
        "min_log_prob_std",
        "noise_clip",
        "denoised_clip",
        "identity_skip",
    )
    divergence_advice = ", or raise min_log_prob_std"

    def __init__(
        self,
        policy: str | type[DPPOPolicy],
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
        process: str = "ddpm",
        n_denoising_steps: int = 10,
        n_finetuned_steps: int | None = None,
        min_sampling_std: float = 0.1,
        min_log_prob_std: float = 0.1,
        noise_clip: float | None = 3.0,
        denoised_clip: float = 1.0,
        identity_skip: bool = True,
        log_prob_clamp: tuple[float, float] | None = (-5.0, 2.0),
        log_prob_reduction: str = "mean",
        denoising_gamma: float = 0.99,
        clip_range_base: float | None = None,
        clip_range_rate: float = 3.0,
        n_critic_warmup: int = 0,
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
        self.process = process
        self.n_denoising_steps = n_denoising_steps
        self.n_finetuned_steps = n_finetuned_steps
        self.min_sampling_std = min_sampling_std
        self.min_log_prob_std = min_log_prob_std
        self.noise_clip = noise_clip
        self.denoised_clip = denoised_clip
        self.identity_skip = identity_skip
        self.log_prob_clamp = log_prob_clamp
        self.log_prob_reduction = log_prob_reduction
        self.denoising_gamma = denoising_gamma
        self.clip_range_base = clip_range_base
        self.clip_range_rate = clip_range_rate
        self.n_critic_warmup = n_critic_warmup
        self.n_entropy_actions = n_entropy_actions
        self.n_entropy_states = n_entropy_states
        self._n_rollouts = 0
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        checks.check_choice("log_prob_reduction", self.log_prob_reduction, ("mean", "sum"))
        checks.check_positive_or_none("clip_range_base", self.clip_range_base)
        checks.check_positive("clip_range_rate", self.clip_range_rate)
        checks.check_count("n_critic_warmup", self.n_critic_warmup, 0)
        if not 0 < self.denoising_gamma <= 1:
            raise ValueError(f"denoising_gamma must be in (0, 1], got {self.denoising_gamma}.")
        if self.log_prob_clamp is not None:
            checks.check_bounds("log_prob_clamp", self.log_prob_clamp)

    def _behavior(self, rollout: FlowRolloutBufferSamples) -> None:
        """Nothing: the record has the old means."""

    def _draw_probes(self, rollout: FlowRolloutBufferSamples, behavior: None) -> tuple[()]:  # noqa: ARG002
        """Nothing: every epoch looks at all trained steps."""
        return ()

    def _policy_terms(
        self,
        batch: FlowRolloutBufferSamples,
        features: th.Tensor,
        behavior: None,  # noqa: ARG002
    ) -> PolicyTerms:
        """Ratios of the trained denoising steps (DPPO, policy gradient of the two-layer MDP)."""
        record: DPPORecord = batch.record
        means = self.policy.trained_means(record.points[:, :-1], features)
        change = (means - record.means) / self.policy.log_prob_stds.unsqueeze(-1)
        log_ratio = self._log_probs(record, means) - self._log_probs(record, record.means)
        regularizer, figures = self._entropy_bonus(features)
        # The divergence of the chains, given the points that they start their steps from.
        divergence = 0.5 * change.square().sum(dim=(-2, -1)).mean()
        if self._is_critic_warming_up:
            log_ratio, regularizer = log_ratio.detach(), regularizer.detach()
        return PolicyTerms(log_ratio, divergence, regularizer, figures)

    def _features(self, batch: FlowRolloutBufferSamples) -> tuple[th.Tensor, th.Tensor]:
        actor_features, critic_features = super()._features(batch)
        if self._is_critic_warming_up and self.policy.share_features_extractor:
            # What extracts them is the actor's too.
            critic_features = critic_features.detach()
        return actor_features, critic_features

    def _log_probs(self, record: DPPORecord, means: th.Tensor) -> th.Tensor:
        """Log likelihoods of the trained steps around some means, shape (n, k)."""
        stds = self.policy.log_prob_stds.unsqueeze(-1)
        energy = 0.5 * ((record.points[:, 1:] - means) / stds).square()
        log_probs = -energy - stds.log() - 0.5 * math.log(2 * math.pi)
        if self.log_prob_clamp is not None:
            log_probs = log_probs.clamp(*self.log_prob_clamp)
        return log_probs.sum(-1) if self.log_prob_reduction == "sum" else log_probs.mean(-1)

    def _surrogate(self, log_ratio: th.Tensor, advantages: th.Tensor) -> th.Tensor:
        """The objective with its denoising discount, of the shape of ``log_ratio``."""
        steps_left = th.arange(log_ratio.shape[-1], device=log_ratio.device).flip(0)
        return self.denoising_gamma**steps_left * super()._surrogate(log_ratio, advantages)

    def _clip_range_now(self) -> float | th.Tensor:
        """epsilon, which may rise with the steps: then of shape (k,)."""
        last = self._now(self.clip_range)
        if self.clip_range_base is None:
            return last
        stds = self.policy.log_prob_stds
        # From 0 to 1; a single step is a last one.
        position = th.linspace(1, 0, len(stds), device=stds.device).flip(0)
        rise = th.expm1(self.clip_range_rate * position) / math.expm1(self.clip_range_rate)
        return self.clip_range_base + (last - self.clip_range_base) * rise

    @property
    def _is_critic_warming_up(self) -> bool:
        return self._n_rollouts < self.n_critic_warmup

    def train(self) -> None:
        """Update the policy with the rollout in the buffer."""
        super().train()
        self._n_rollouts += 1

    def _adapt_learning_rate(self, divergences: list[th.Tensor]) -> None:
        # A policy that does not learn gives no reason to learn faster.
        if not self._is_critic_warming_up:
            super()._adapt_learning_rate(divergences)

    def learn(
        self: SelfDPPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "DPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDPPO:
        """Train for ``total_timesteps``; see SB3."""
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )
