"""The losses of PolicyFlow's actor and of the critic, evaluated and differentiated by kernels."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_policyflow.kernels.compiler import note_fallback
from sb3_policyflow.kernels.critic import read_critic
from sb3_policyflow.kernels.fields import Embedding, FieldParts, KernelVelocityField
from sb3_policyflow.kernels.inspection import KernelView, are_usable
from sb3_policyflow.kernels.layouts import (
    BROWNIAN,
    CHANGE,
    CLIPPED,
    KL,
    LARGEST,
    N_SUMS,
    OBJECTIVE,
    RATIO,
    VALUE,
    Floats,
    LossOptions,
    LossTargets,
    MLPGradients,
)
from sb3_policyflow.kernels.mlp import MLP, NO_POINTS, mlp_input, views_like
from sb3_policyflow.kernels.threads import in_parts, n_parts

UNIT_ENTROPY = 0.5 * math.log(2 * math.pi * math.e)
"""Entropy of a Gaussian with a standard deviation of 1, in nats."""


class LossInputs(NamedTuple):
    """A minibatch of m samples, with k times for each.

    ``features`` and ``critic_features`` (m, ...) and ``log_std`` (dim,) may have gradients.
    ``times`` (m, k), ``points`` and ``reference_velocity`` (m, k, dim), ``actions`` and
    ``endpoints`` (m, dim), ``advantages``, ``old_values`` and ``returns`` (m,), ``old_log_std``
    (dim,) have none.
    """

    features: th.Tensor
    critic_features: th.Tensor
    log_std: th.Tensor
    times: th.Tensor
    points: th.Tensor
    reference_velocity: th.Tensor
    actions: th.Tensor
    endpoints: th.Tensor
    advantages: th.Tensor
    old_values: th.Tensor
    returns: th.Tensor
    old_log_std: th.Tensor


class LossTerms(NamedTuple):
    """Means over a minibatch of what its loss consists of, but for the ``log_ratio_max``."""

    policy_gradient_loss: float
    clip_fraction: float
    ratio_mean: float
    log_ratio_max: float
    kl: float
    brownian_loss: float
    velocity_change: float
    entropy: float
    value_loss: float


class KernelLoss:
    """Evaluates and differentiates the losses of PolicyFlow's actor and of the critic.

    The loss is policy_gradient_loss + brownian_coef * brownian_loss - ent_coef * entropy
    + vf_coef * value_loss.

    :param options: Options of the losses.
    :param scores: The interpolant's score coefficients at times (n,), each of shape (n,).
    """

    def __init__(
        self, options: LossOptions, scores: Callable[[th.Tensor], tuple[th.Tensor, ...]]
    ) -> None:
        self.options = options
        self.scores = scores
        self._critic = KernelView(read_critic)

    def __call__(self, policy: Any, inputs: LossInputs) -> "EvaluatedLoss | None":
        """The loss of a minibatch.

        :param policy: A policy with a velocity field of kernels and SB3's critic.
        :param inputs: The minibatch.
        :return: None where kernels cannot work.
        """
        field, critic = policy.velocity, self._critic.of(policy)
        actor = field.parts() if type(field) is KernelVelocityField else "not a field of kernels"
        if isinstance(actor, str) or isinstance(critic, str):
            return None
        parameters = [inputs.log_std, *actor.parameters, *critic.tensors]
        if any(p._backward_hooks or p._post_accumulate_grad_hooks for p in parameters):
            note_fallback("parameters have hooks")
            return None
        if not are_usable(inputs) or not actor.supports(inputs.points, inputs.features):
            note_fallback("a minibatch is not contiguous float32 on the CPU")
            return None
        return EvaluatedLoss(self, actor, critic, inputs)


class EvaluatedLoss:
    """The loss of a minibatch, which has its gradients from the start.

    It can be used in place of the tensor that autograd would go back from: ``item`` and
    ``backward`` are a tensor's.

    :param loss: The loss.
    :param actor: The velocity field.
    :param critic: The critic.
    :param inputs: The minibatch.
    """

    def __init__(
        self, loss: KernelLoss, actor: FieldParts, critic: MLP, inputs: LossInputs
    ) -> None:
        self._options, self._actor, self._critic = loss.options, actor, critic
        self._inputs = inputs
        self._n_samples, self._n_times = inputs.times.shape
        arrays: Any = LossInputs._make(tensor.detach().numpy() for tensor in inputs)
        self._embedding = Embedding(actor, arrays.times)
        points = arrays.points.reshape(-1, actor.dim)
        shape = inputs.times.shape
        self._first = self._embedding.kernel_input(points, arrays.features, shape, shape)
        self._critic_first = mlp_input(critic, inputs.critic_features)
        self._targets = LossTargets(
            arrays.actions,
            arrays.endpoints,
            arrays.advantages,
            arrays.reference_velocity.reshape(-1, actor.dim),
            th.stack(loss.scores(th.from_numpy(self._embedding.times)), dim=1).numpy(),
            arrays.log_std,
            arrays.old_log_std,
            arrays.old_values,
            arrays.returns,
        )
        self._grad_features, self._grad_critic_features = (
            th.empty_like(features if features.requires_grad else features[:0])
            for features in inputs[:2]
        )
        self._compute()
        self.terms = self._terms(arrays.log_std)

    def _compute(self) -> None:
        """Compute gradients and sums, on all threads.

        The gradients of all parameters are one tensor: those of the actor, log_std and critic.
        """
        actor, critic = self._actor, self._critic
        first, critic_first = self._first, self._critic_first
        n_first = first.weights.size + first.table.size
        begin, end = actor.n_embedding, actor.n_parameters + actor.dim
        n_critic_first = critic_first.weights.size + critic_first.table.size
        flops = 3 * (self._n_times * actor.network.flops_per_row + critic.flops_per_row)
        parts = n_parts(self._n_samples, flops)
        firsts = np.zeros((parts, n_first + n_critic_first), dtype=np.float32)
        total = th.zeros(parts, end + critic.n_parameters, dtype=th.float32, device="cpu")
        flat, sums = total.numpy(), np.zeros((parts, N_SUMS))
        features, critic_features = self._grad_features.numpy(), self._grad_critic_features.numpy()
        run, targets, options = critic.kernels.loss_gradients, self._targets, self._options

        def run_part(part: int, start: int, stop: int) -> None:
            of_first, others = firsts[part, :n_first], flat[part, begin:end]
            grads = MLPGradients(of_first, others, NO_POINTS, features)
            rows = (sums[part], start, stop)
            run(first, actor.network.layout, targets, options, True, grads, *rows)
            of_first, others = firsts[part, n_first:], flat[part, end + n_critic_first :]
            grads = MLPGradients(of_first, others, NO_POINTS, critic_features)
            run(critic_first, critic.layout, targets, options, False, grads, *rows)

        in_parts(self._n_samples, parts, run_part)
        self._sums, of_first, self._flat = sums[0], firsts[0], total[0]
        if parts > 1:
            self._sums, of_first, self._flat = sums.sum(axis=0), firsts.sum(axis=0), total.sum(0)
            self._sums[LARGEST] = sums[:, LARGEST].max()
        flat, shape = self._flat.numpy(), critic_first.weights.shape
        self._embedding.backward(of_first[:n_first], flat[:begin])
        flat[end - actor.dim : end] -= options.ent_coef
        weight_end = n_first + critic_first.weights.size
        of_weight, of_bias = of_first[n_first:weight_end].reshape(shape), of_first[weight_end:]
        of_critic = flat[end : end + n_critic_first]
        of_critic[: of_weight.size].reshape(shape[::-1])[:] = of_weight.T
        of_critic[of_weight.size :] = of_bias

    def _terms(self, log_std: Floats) -> LossTerms:
        sums, n = self._sums.tolist(), self._n_samples
        n_rows = n * self._n_times
        n_surrogates = n if self._options.averages_shift else n_rows
        return LossTerms(
            policy_gradient_loss=-sums[OBJECTIVE] / n_surrogates,
            clip_fraction=sums[CLIPPED] / n_surrogates,
            ratio_mean=sums[RATIO] / n_surrogates,
            log_ratio_max=sums[LARGEST],
            kl=sums[KL] / n_surrogates,
            brownian_loss=sums[BROWNIAN] / n_rows,
            velocity_change=sums[CHANGE] / n_rows,
            entropy=float(log_std.sum()) + len(log_std) * UNIT_ENTROPY,
            value_loss=sums[VALUE] / n,
        )

    def item(self) -> float:
        """The loss."""
        terms, options = self.terms, self._options
        loss = terms.policy_gradient_loss + options.vf_coef * terms.value_loss
        loss -= options.ent_coef * terms.entropy
        if options.brownian_coef != 0.0:  # it may be infinite
            loss += options.brownian_coef * terms.brownian_loss
        return loss

    def backward(self, inputs: Sequence[th.Tensor] | None = None) -> None:
        """Add the gradients to those that the parameters have.

        :param inputs: The parameters; all if not given.
        """
        actor, critic = self._actor, self._critic
        tensors = [*actor.parameters, self._inputs.log_std, *critic.tensors]
        gradients = [*views_like(tensors, self._flat)]
        tensors += self._inputs[:2]
        gradients += [self._grad_features, self._grad_critic_features]
        wanted = None if inputs is None else set(inputs)
        roots, root_gradients = list[th.Tensor](), list[th.Tensor]()
        for tensor, gradient in zip(tensors, gradients, strict=True):
            if not tensor.requires_grad:
                continue
            if not tensor.is_leaf:
                roots.append(tensor)
                root_gradients.append(gradient)
            elif wanted is None or tensor in wanted:
                tensor.grad = gradient if tensor.grad is None else tensor.grad + gradient
        behind = None if wanted is None else list(wanted.difference(tensors))
        if roots and behind != []:
            th.autograd.backward(roots, root_gradients, inputs=behind)
