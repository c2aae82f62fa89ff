"""The losses of PolicyFlow's actor and of the critic as one node of autograd's graph."""

import math
from collections.abc import Callable
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
    LossOptions,
    LossTargets,
    MLPGradients,
)
from sb3_policyflow.kernels.mlp import (
    MLP,
    NO_POINTS,
    gradient_sizes,
    mlp_input,
    split_gradients,
)
from sb3_policyflow.kernels.threads import in_parts, n_parts


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

    def __call__(self, policy: Any, inputs: LossInputs) -> tuple[th.Tensor, LossTerms] | None:
        """The loss, whose gradients are known already, and its terms.

        :param policy: A policy with a velocity field of kernels and SB3's critic.
        :param inputs: The minibatch.
        :return: None where kernels cannot work.
        """
        field, critic = policy.velocity, self._critic.of(policy)
        actor = field.parts() if type(field) is KernelVelocityField else "not a field of kernels"
        if isinstance(actor, str) or isinstance(critic, str):
            return None
        if not are_usable(inputs) or not actor.supports(inputs.points, inputs.features):
            note_fallback("a minibatch is not contiguous float32 on the CPU")
            return None
        parameters = (*actor.parameters, *critic.tensors)
        compute = _Minibatch(self, actor, critic, inputs)
        node: Any = _Loss.apply
        return node(compute, *inputs[:3], *parameters), compute.terms()


class _Minibatch:
    """A minibatch on its way through the kernels: computed at once, gradients included.

    :param loss: The loss.
    :param actor: The velocity field.
    :param critic: The critic.
    :param inputs: The minibatch.
    """

    def __init__(
        self, loss: KernelLoss, actor: FieldParts, critic: MLP, inputs: LossInputs
    ) -> None:
        self.options, self.actor, self.critic = loss.options, actor, critic
        self.n_samples, self.n_times = inputs.times.shape
        arrays = LossInputs(*(tensor.detach().numpy() for tensor in inputs))
        self.embedding = Embedding(actor, arrays.times)
        self.first = self.embedding.kernel_input(
            arrays.points.reshape(-1, actor.dim),
            arrays.features,
            inputs.times.shape,
            inputs.times.shape,
        )
        self.critic_first = mlp_input(critic, inputs.critic_features)
        scores = th.stack(loss.scores(th.from_numpy(self.embedding.times)), dim=1)
        self.targets = LossTargets(
            arrays.actions,
            arrays.endpoints,
            arrays.advantages,
            arrays.reference_velocity.reshape(-1, actor.dim),
            scores.numpy(),
            arrays.log_std,
            arrays.old_log_std,
            arrays.old_values,
            arrays.returns,
        )
        self.entropy = float(
            arrays.log_std.sum() + actor.dim * 0.5 * math.log(2 * math.pi * math.e)
        )
        self.grad_features = self._empty_like(inputs.features)
        self.grad_critic_features = self._empty_like(inputs.critic_features)
        self._compute()

    @staticmethod
    def _empty_like(features: th.Tensor) -> th.Tensor:
        return th.empty_like(features if features.requires_grad else features[:0])

    def _compute(self) -> None:
        """Fill gradients and sums, on all threads."""
        actor, critic = self.actor.network, self.critic
        self.sizes = gradient_sizes(self.first, actor.tensors)
        self.critic_sizes = gradient_sizes(self.critic_first, critic.tensors)
        n_actor, n_critic = sum(self.sizes) + self.actor.dim, sum(self.critic_sizes)
        flops = 3 * (self.n_times * actor.flops_per_row + critic.flops_per_row)
        parts = n_parts(self.n_samples, flops)
        flat = th.zeros(parts, n_actor + n_critic, dtype=th.float32, device="cpu")
        sums, of_thread = np.zeros((parts, N_SUMS)), flat.numpy()
        run, targets, options = critic.kernels.loss_gradients, self.targets, self.options
        features = self.grad_features.numpy()
        critic_features = self.grad_critic_features.numpy()

        def run_part(part: int, start: int, stop: int) -> None:
            grads = MLPGradients(of_thread[part, :n_actor], NO_POINTS, features)
            arguments = (targets, options, True, grads, sums[part], start, stop)
            run(self.first, actor.layout, *arguments)
            grads = MLPGradients(of_thread[part, n_actor:], NO_POINTS, critic_features)
            arguments = (targets, options, False, grads, sums[part], start, stop)
            run(self.critic_first, critic.layout, *arguments)

        in_parts(self.n_samples, parts, run_part)
        self.flat = flat[0] if parts == 1 else flat.sum(0)
        self.flat[n_actor - self.actor.dim : n_actor] -= options.ent_coef  # entropy by log_std
        self.sums = sums.sum(axis=0)
        self.sums[LARGEST] = sums[:, LARGEST].max()

    def terms(self) -> LossTerms:
        """What the loss consists of."""
        sums, options, n = self.sums, self.options, self.n_samples
        n_rows = n * self.n_times
        n_surrogates = n if options.averages_shift else n_rows
        return LossTerms(
            policy_gradient_loss=-sums[OBJECTIVE] / n_surrogates,
            clip_fraction=sums[CLIPPED] / n_surrogates,
            ratio_mean=sums[RATIO] / n_surrogates,
            log_ratio_max=sums[LARGEST],
            kl=sums[KL] / n_surrogates,
            brownian_loss=sums[BROWNIAN] / n_rows,
            velocity_change=sums[CHANGE] / n_rows,
            entropy=self.entropy,
            value_loss=sums[VALUE] / n,
        )

    def loss(self) -> float:
        """The sum of the losses."""
        terms, options = self.terms(), self.options
        loss = terms.policy_gradient_loss + options.vf_coef * terms.value_loss
        loss -= options.ent_coef * terms.entropy
        if options.brownian_coef != 0.0:  # it may be infinite
            loss += options.brownian_coef * terms.brownian_loss
        return loss

    def scale_gradients(self, factor: float) -> None:
        """Multiply all gradients by a number."""
        for tensor in (self.flat, self.grad_features, self.grad_critic_features):
            tensor.mul_(factor)

    def gradients(self) -> list[th.Tensor | None]:
        """Gradients of both features, log_std, and the parameters of actor and critic."""
        sizes = [sum(self.sizes), self.actor.dim, sum(self.critic_sizes)]
        of_actor, log_std, of_critic = th.split(self.flat, sizes)
        actor = split_gradients(of_actor, self.sizes, self.first, self.actor.network.tensors)
        critic = split_gradients(
            of_critic, self.critic_sizes, self.critic_first, self.critic.tensors
        )
        return [
            self.grad_features if len(self.grad_features) else None,
            self.grad_critic_features if len(self.grad_critic_features) else None,
            log_std,
            *self.embedding.backward(actor),
            *actor.others,
            critic.weights.T.contiguous(),
            critic.table[0],
            *critic.others,
        ]


class _Loss(th.autograd.Function):
    """The loss of a minibatch as a node of autograd's graph."""

    @staticmethod
    def forward(ctx: Any, minibatch: _Minibatch, *differentiable: th.Tensor) -> th.Tensor:
        ctx.minibatch = minibatch
        ctx.save_for_backward(*differentiable)  # none of which may change before the backward pass
        return th.tensor(minibatch.loss(), dtype=th.float32, device="cpu")

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, grad_output: th.Tensor) -> Any:
        _ = ctx.saved_tensors  # checks that none has changed
        minibatch, ctx.minibatch = ctx.minibatch, None
        if minibatch is None:
            raise RuntimeError(
                "This loss gives its gradients away: it has no second backward pass."
            )
        scale = grad_output.item()
        if scale != 1.0:
            minibatch.scale_gradients(scale)
        return None, *minibatch.gradients()
