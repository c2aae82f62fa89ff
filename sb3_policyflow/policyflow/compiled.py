"""PolicyFlow's loss in one call of a kernel, in place of its formulas."""

import math
from typing import TYPE_CHECKING

import torch as th

from sb3_policyflow.common.buffers import FlowRolloutBufferSamples
from sb3_policyflow.common.losses import SURROGATES, clipped_surrogate
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.update import CompiledLoss, CompiledTerms
from sb3_policyflow.flows import Interpolant
from sb3_policyflow.kernels import KernelLoss, LossInputs, LossOptions

if TYPE_CHECKING:  # that module imports this one
    from sb3_policyflow.policyflow.policyflow import PolicyFlowUpdate


def make_compiled_loss(update: "PolicyFlowUpdate") -> CompiledLoss | None:
    """The loss of an update, as :meth:`~.FlowUpdate.loss` computes it.

    :param update: The update, with the formulas of its class.
    :return: None if it has terms that no kernel knows.
    """
    policy, interpolant = update.policy, update.flow.interpolant
    has_known_formulas = (
        SURROGATES[update.trust_region] is clipped_surrogate
        and update.uniform_targets is None
        and getattr(type(policy), "values", None) is FlowPolicy.values
        and type(interpolant).brownian_residual is Interpolant.brownian_residual
    )
    clip_range = update.clip_range
    if not has_known_formulas or not isinstance(clip_range, float):
        return None
    unbounded = math.inf
    options = LossOptions(
        end_time=interpolant.end_time,
        averages_shift=update.time_average == "shift",
        clip_range=clip_range,
        log_ratio_clamp=unbounded if update.log_ratio_clamp is None else update.log_ratio_clamp,
        brownian_coef=update.brownian_coef,
        sums_dimensions=update.brownian_reduction == "sum",
        ent_coef=update.ent_coef,
        vf_coef=update.vf_coef,
        clip_range_vf=unbounded if update.clip_range_vf is None else update.clip_range_vf,
    )
    return CompiledPolicyFlowLoss(update, KernelLoss(options, interpolant.score_coefficients))


class CompiledPolicyFlowLoss:
    """PolicyFlow's loss of a minibatch, by a kernel.

    :param update: The update that it is a part of.
    :param kernel: The kernel, with the options of the update.
    """

    def __init__(self, update: "PolicyFlowUpdate", kernel: KernelLoss) -> None:
        self._policy, self._kernel = update.policy, kernel
        self._old_log_std = update.reference_log_std
        self._latent_std = update.latent_std * th.ones_like(update.reference_log_std)

    def __call__(
        self, batch: FlowRolloutBufferSamples, features: th.Tensor, critic_features: th.Tensor
    ) -> CompiledTerms | None:
        inputs = LossInputs(
            features=features,
            critic_features=critic_features,
            log_std=self._policy.noise_log_std,
            times=batch.drawn.times,
            points=batch.drawn.points,
            reference_velocity=batch.drawn.reference_velocity,
            actions=batch.actions,
            endpoints=batch.record.endpoints,
            advantages=batch.advantages,
            old_values=batch.old_values,
            returns=batch.returns,
            old_log_std=self._old_log_std,
            latent_std=self._latent_std,
        )
        evaluated = self._kernel(self._policy, inputs)
        if evaluated is None:
            return None
        means = evaluated.terms._asdict()
        kl = th.tensor(means.pop("kl"), dtype=th.float32, device="cpu")
        maxima = {"log_ratio_max": means.pop("log_ratio_max")}
        means["entropy_loss"] = -means.pop("entropy")
        return CompiledTerms(evaluated, kl, means, maxima)
