"""The losses of PolicyFlow's actor and of the critic, evaluated and differentiated by kernels."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_policyflow.kernels.compiler import note_fallback
from sb3_policyflow.kernels.critic import read_critic
from sb3_policyflow.kernels.field_parts import FieldParts
from sb3_policyflow.kernels.fields import Embedding, KernelVelocityField
from sb3_policyflow.kernels.inspection import KernelView, are_usable, have_hooks
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
    """n samples, with k times for each.

    ``features`` and ``critic_features`` (n, ...) may have gradients. ``times`` (n, k), ``points``
    and ``reference_velocity`` (n, k, dim), ``actions`` and ``endpoints`` (n, dim), ``advantages``,
    ``old_values`` and ``returns`` (n,) have none.
    """

    features: th.Tensor
    critic_features: th.Tensor
    times: th.Tensor
    points: th.Tensor
    reference_velocity: th.Tensor
    actions: th.Tensor
    endpoints: th.Tensor
    advantages: th.Tensor
    old_values: th.Tensor
    returns: th.Tensor


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
    """The losses of PolicyFlow's actor and of the critic, with their gradients.

    The loss is policy_gradient_loss + brownian_coef * brownian_loss - ent_coef * entropy
    + vf_coef * value_loss.

    :param options: Options of the losses.
    :param scores: The interpolant's score coefficients at times (...), each of shape (...).
    :param old_log_std: Of the reference policy's noise, shape (dim,), without gradient.
    :param latent_std: Standard deviations of the latents, shape (dim,), without gradient.
    """

    def __init__(
        self,
        options: LossOptions,
        scores: Callable[[th.Tensor], tuple[th.Tensor, ...]],
        old_log_std: th.Tensor,
        latent_std: th.Tensor,
    ) -> None:
        self.options = options
        self.scores = scores
        self.stds = old_log_std, latent_std
        self._critic = KernelView(read_critic)

    def prepare(self, policy: Any, inputs: LossInputs) -> "PreparedLoss | None":
        """Everything but the evaluation, for samples that are evaluated a few at a time.

        :param policy: A policy with a velocity field of kernels, a ``noise_log_std`` and SB3's
            critic. Its modules must not change before the last evaluation, but its weights may.
        :param inputs: The samples.
        :return: None where kernels cannot work.
        """
        field, critic = policy.velocity, self._critic.of(policy)
        actor = field.parts() if type(field) is KernelVelocityField else "not a field of kernels"
        if isinstance(actor, str) or isinstance(critic, str):
            return None
        log_std = policy.noise_log_std
        parameters = [log_std, *actor.parameters, *critic.tensors]
        if have_hooks(parameters):
            note_fallback("parameters have hooks")
            return None
        is_known = actor.supports(inputs.points, inputs.features)
        if not is_known or not are_usable((log_std, *self.stds, *inputs)):
            note_fallback("samples are not contiguous float32 on the CPU")
            return None
        return PreparedLoss(self, policy, actor, critic, inputs)


class PreparedLoss:
    """The losses of some samples, of which any part can be evaluated.

    :param loss: The losses.
    :param policy: The policy.
    :param actor: Its velocity field.
    :param critic: Its critic.
    :param inputs: The samples.
    """

    def __init__(
        self, loss: KernelLoss, policy: Any, actor: FieldParts, critic: MLP, inputs: LossInputs
    ) -> None:
        self.loss, self.actor, self.critic = loss, actor, critic
        self._policy, self._inputs = policy, inputs
        self._arrays: Any = LossInputs._make(tensor.detach().numpy() for tensor in inputs)
        self._scores: Floats = th.stack(loss.scores(inputs.times), dim=-1).numpy()
        self.old_log_std, self.latent_std = (std.numpy() for std in loss.stds)
        self._tensors = [*actor.tensors, *critic.tensors]
        self._places = [*actor.places, *critic.places]

    def evaluate(self, rows: slice) -> "EvaluatedLoss | None":
        """The loss of some of the samples.

        :param rows: Which, with a step of 1.
        :return: None if weights are no longer where they were: the samples must be prepared again.
        """
        if [tensor.data_ptr() for tensor in self._tensors] != self._places:
            return None
        arrays: Any = LossInputs._make(array[rows] for array in self._arrays)
        features, critic_features = (
            values[rows] if values.requires_grad else values[:0] for values in self._inputs[:2]
        )
        log_std = self._policy.noise_log_std
        return EvaluatedLoss(self, arrays, self._scores[rows], log_std, (features, critic_features))


class EvaluatedLoss:
    """The loss of a minibatch, which has its gradients from the start.

    It can be used in place of the tensor that autograd would go back from: ``item`` and
    ``backward`` are a tensor's.

    :param prepared: What it is evaluated by.
    :param arrays: The samples.
    :param scores: The interpolant's score coefficients at their times, shape (n, k, 3).
    :param log_std: Of the noise, which may have a gradient.
    :param features: Those of actor and critic; no rows of those that have no gradient.
    """

    def __init__(
        self,
        prepared: PreparedLoss,
        arrays: Any,
        scores: Floats,
        log_std: th.Tensor,
        features: tuple[th.Tensor, th.Tensor],
    ) -> None:
        actor = prepared.actor
        self._prepared, self._options = prepared, prepared.loss.options
        self._log_std, self._features = log_std, features
        self._n_samples, self._n_times = shape = arrays.times.shape
        self._embedding = Embedding(actor, arrays.times)
        points, reference = arrays.points, arrays.reference_velocity
        self._first = self._embedding.kernel_input(
            points.reshape(-1, actor.dim), arrays.features, shape, shape
        )
        self._critic_first = mlp_input(prepared.critic, arrays.critic_features)
        self._targets = LossTargets(
            arrays.actions,
            arrays.endpoints,
            arrays.advantages,
            reference.reshape(-1, actor.dim),
            scores.reshape(-1, 3),
            prepared.latent_std,
            log_std.detach().numpy(),
            prepared.old_log_std,
            arrays.old_values,
            arrays.returns,
        )
        self._grad_features, self._grad_critic_features = map(th.empty_like, features)
        self._compute()
        self.terms = self._terms()

    def _compute(self) -> None:
        """Compute gradients and sums, on all threads."""
        actor, critic = self._prepared.actor, self._prepared.critic
        first, critic_first = self._first, self._critic_first
        n_first = first.weights.size + first.table.size
        begin, end = actor.n_embedding, actor.n_parameters + actor.dim
        n_critic_first = critic_first.weights.size + critic_first.table.size
        flops = 3 * (self._n_times * actor.network.flops_per_row + critic.flops_per_row)
        parts = n_parts(self._n_samples, flops)
        firsts = np.zeros((parts, n_first + n_critic_first), dtype=np.float32)
        flat = np.zeros((parts, end + critic.n_parameters), dtype=np.float32)
        sums = np.zeros((parts, N_SUMS))
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
        self._sums, of_first, self._flat = sums[0], firsts[0], flat[0]
        if parts > 1:
            self._sums, of_first, self._flat = sums.sum(0), firsts.sum(0), flat.sum(0)
            self._sums[LARGEST] = sums[:, LARGEST].max()
        shape = critic_first.weights.shape
        self._embedding.backward(of_first[:n_first], self._flat[:begin])
        self._flat[end - actor.dim : end] -= options.ent_coef
        weight_end = n_first + critic_first.weights.size
        of_weight, of_bias = of_first[n_first:weight_end].reshape(shape), of_first[weight_end:]
        of_critic = self._flat[end : end + n_critic_first]
        of_critic[: of_weight.size].reshape(shape[::-1])[:] = of_weight.T
        of_critic[of_weight.size :] = of_bias

    def _terms(self) -> LossTerms:
        sums, n = self._sums.tolist(), self._n_samples
        log_std = self._targets.log_std.tolist()
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
            entropy=math.fsum(log_std) + len(log_std) * UNIT_ENTROPY,
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
        actor, critic = self._prepared.actor, self._prepared.critic
        tensors = [*actor.parameters, self._log_std, *critic.tensors]
        gradients = views_like(tensors, th.from_numpy(self._flat))
        tensors += self._features
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
