"""PolicyFlow's loss in one call of a kernel, in place of its formulas."""

import math
from typing import TYPE_CHECKING

import torch as th

from sb3_policyflow.common.losses import SURROGATES, clipped_surrogate
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.update import CompiledLoss, EvaluatedTerms, EvaluateRows
from sb3_policyflow.flows import Interpolant
from sb3_policyflow.kernels import EvaluatedLoss, KernelLoss, LossInputs, LossOptions, are_usable

if TYPE_CHECKING:  # that module imports this one
    from sb3_policyflow.policyflow.policies import PolicyFlowPolicy
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
    clip_range, log_std = update.clip_range, update.reference_log_std
    stds = log_std, (update.latent_std * th.ones_like(log_std)).detach()
    if not has_known_formulas or not isinstance(clip_range, float) or not are_usable(stds):
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
    kernel = KernelLoss(options, interpolant.score_coefficients, *stds)
    return CompiledPolicyFlowLoss(policy, kernel)


class CompiledPolicyFlowLoss:
    """PolicyFlow's loss by a kernel, see :data:`~sb3_policyflow.common.update.CompiledLoss`.

    :param policy: The policy.
    :param kernel: The kernel.
    """

    def __init__(self, policy: "PolicyFlowPolicy", kernel: KernelLoss) -> None:
        self._policy, self._kernel = policy, kernel

    def __call__(
        self, samples: FlowRolloutBufferSamples, features: th.Tensor, critic_features: th.Tensor
    ) -> EvaluateRows | None:
        inputs = LossInputs(
            features=features,
            critic_features=critic_features,
            times=samples.drawn.times,
            points=samples.drawn.points,
            reference_velocity=samples.drawn.reference_velocity,
            actions=samples.actions,
            endpoints=samples.record.endpoints,
            advantages=samples.advantages,
            old_values=samples.old_values,
            returns=samples.returns,
        )
        prepared = self._kernel.prepare(self._policy, inputs)
        return None if prepared is None else lambda rows: _terms(prepared.evaluate(rows))


def _terms(evaluated: EvaluatedLoss | None) -> EvaluatedTerms | None:
    """A minibatch's loss by its parts."""
    if evaluated is None:
        return None
    means = evaluated.terms._asdict()
    kl = th.tensor(means.pop("kl"), dtype=th.float32, device="cpu")
    maxima = {"log_ratio_max": means.pop("log_ratio_max")}
    means["entropy_loss"] = -means.pop("entropy")
    return EvaluatedTerms(evaluated, kl, means, maxima)
