"""The losses of PolicyFlow's actor and of the critic, with their gradients.

The formulas are those of :mod:`sb3_policyflow.common.losses`, of
:class:`~sb3_policyflow.policyflow.policyflow.PolicyFlowUpdate` and of
:class:`~sb3_policyflow.flows.Interpolant`, which are the reference, with their derivatives.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_policyflow.kernels._numba.matrices import floats, project
from sb3_policyflow.kernels._numba.mlp import (
    arranged,
    backward_block,
    backward_scratch,
    first_layer,
    first_layer_backward,
    hidden_layers,
    rows_of_a_block,
    rows_of_a_sample,
    total,
)
from sb3_policyflow.kernels._numba.options import F, exact, kernel
from sb3_policyflow.kernels._numba.views import block, matrix, span, vector
from sb3_policyflow.kernels.layouts import (
    BROWNIAN,
    CHANGE,
    CLIPPED,
    KL,
    LARGEST,
    OBJECTIVE,
    RATIO,
    VALUE,
    Floats,
    KernelInput,
    LossOptions,
    LossTargets,
    MLPGradients,
    MLPLayout,
)


@kernel
def loss_gradients(
    first: KernelInput,
    network: MLPLayout,
    targets: LossTargets,
    options: LossOptions,
    is_actor: bool,
    gradients: MLPGradients,
    sums: NDArray[np.float64],
    start: int,
    stop: int,
) -> None:
    """Add the gradients of an actor's or a critic's loss on some samples.

    Each block of samples goes forward, through the loss and back while it is in the caches.

    :param first: The first layer.
    :param network: The velocity field or the critic.
    :param targets: What its outputs should be.
    :param options: Options of the losses.
    :param is_actor: Whether it is the velocity field.
    :param gradients: Added to. Behind those of an actor's other layers follows that of log_std.
    :param sums: Added to, see :data:`~sb3_policyflow.kernels.layouts.N_SUMS`.
    :param start: The first sample.
    :param stop: The sample behind the last.
    """
    group, block_rows, widths = rows_of_a_sample(first), rows_of_a_block(first), network.widths
    n_outputs, n_saved = targets.log_std.size if is_actor else 1, total(widths)
    most = min(block_rows, (stop - start) * group)
    values, derivatives = floats(most * n_saved), floats(most * n_saved)
    outputs, grad_outputs = floats(most * n_outputs), floats(most * n_outputs)
    scratch, hidden = backward_scratch(network, most), arranged(network)
    weight = matrix(network.weights[-1], n_outputs, widths[-1])
    bias = vector(network.biases[-1], n_outputs)
    n_others = gradients.others.size - (n_outputs if is_actor else 0)
    of_layers = span(gradients.others, 0, n_others)
    of_log_std = span(gradients.others, n_others, gradients.others.size - n_others)
    for begin in range(start * group, stop * group, block_rows):
        end = min(begin + block_rows, stop * group)
        n_rows, size = end - begin, (end - begin) * n_saved
        of_values, of_derivatives = span(values, 0, size), span(derivatives, 0, size)
        found = block(outputs, 0, n_rows, n_outputs)
        grads = block(grad_outputs, 0, n_rows, n_outputs)
        first_layer(first, begin, end, block(values, 0, n_rows, widths[0]))
        last = hidden_layers(
            hidden, widths, network.activation, F(network.alpha), of_values, of_derivatives
        )
        project(last, weight, bias, found)
        if is_actor:
            _actor_loss(first, targets, options, found, grads, of_log_std, sums, begin)
        else:
            _critic_loss(targets, options, found, grads, sums, begin)
        grad = backward_block(network, of_values, of_derivatives, grads, of_layers, scratch)
        first_layer_backward(first, begin, end, grad, gradients)


@exact
def _critic_loss(
    targets: LossTargets,
    options: LossOptions,
    values: Floats,
    grads: Floats,
    sums: NDArray[np.float64],
    begin: int,
) -> None:
    """The squared error of a block's values, whose change is clipped."""
    scale, bound = F(2.0 * options.vf_coef / targets.returns.size), F(options.clip_range_vf)
    for i in range(values.shape[0]):
        value, old = values[i, 0], targets.old_values[begin + i]
        is_clipped = abs(value - old) > bound
        if is_clipped:
            value = old + (bound if value > old else -bound)
        error = value - targets.returns[begin + i]
        sums[VALUE] += error * error
        grads[i, 0] = F(0.0) if is_clipped else scale * error


@exact
def _actor_loss(
    first: KernelInput,
    targets: LossTargets,
    options: LossOptions,
    velocity: Floats,
    grads: Floats,
    grad_log_std: Floats,
    sums: NDArray[np.float64],
    begin: int,
) -> None:
    """The surrogate objective and the Brownian regularizer of a block's velocities."""
    group, (n_rows, dim) = rows_of_a_sample(first), velocity.shape
    # Rows whose mean shift has one surrogate
    together = group if options.averages_shift else 1
    shift = floats(dim)
    for row in range(0, n_rows, together):
        sample = (begin + row) // group
        for i in range(dim):
            shift[i] = F(0.0)
            for other in range(row, row + together):
                reference = targets.reference_velocity[begin + other, i]
                shift[i] += F(options.end_time) * (velocity[other, i] - reference)
            shift[i] /= F(together)
        n_surrogates = first.points.shape[0] // together
        slope = _surrogate(targets, options, sample, shift, sums) / F(n_surrogates)
        to_velocity = slope * F(options.end_time) / F(together)
        for i in range(dim):
            variance = math.exp(F(2.0) * targets.log_std[i])
            deviation = targets.actions[sample, i] - targets.endpoints[sample, i] - shift[i]
            grad_log_std[i] += slope * (deviation * deviation / variance - F(1.0))
            for other in range(row, row + together):
                grads[other, i] = to_velocity * deviation / variance
    for row in range(n_rows):
        _regularize(first, targets, options, begin + row, velocity[row], grads[row], sums)


@exact
def _surrogate(
    targets: LossTargets,
    options: LossOptions,
    sample: int,
    shift: Floats,
    sums: NDArray[np.float64],
) -> Any:
    """Add a sample's terms; the derivative of the negative objective by the log ratio."""
    log_ratio, divergence = F(0.0), F(0.0)
    for i in range(shift.size):
        noise = targets.actions[sample, i] - targets.endpoints[sample, i]
        log_std, old_log_std = targets.log_std[i], targets.old_log_std[i]
        new = (noise - shift[i]) / math.exp(log_std)
        old = noise / math.exp(old_log_std)
        log_ratio += (F(0.5) * old * old + old_log_std) - (F(0.5) * new * new + log_std)
        variance, old_variance = math.exp(F(2.0) * log_std), math.exp(F(2.0) * old_log_std)
        spread = (old_variance + shift[i] * shift[i]) / (F(2.0) * variance) - F(0.5)
        divergence += log_std - old_log_std + spread
    sums[KL] += divergence
    if not abs(log_ratio) <= sums[LARGEST]:  # NaN, too
        sums[LARGEST] = abs(log_ratio)
    bound, epsilon = F(options.log_ratio_clamp), F(options.clip_range)
    is_within = abs(log_ratio) <= bound
    if log_ratio > bound:
        log_ratio = bound
    elif log_ratio < -bound:
        log_ratio = -bound
    advantage, ratio = targets.advantages[sample], math.exp(log_ratio)
    clipped = min(max(ratio, F(1.0) - epsilon), F(1.0) + epsilon)
    objective, bounded = ratio * advantage, clipped * advantage
    # Where the clipped one is less, it does not depend on the ratio.
    has_slope = is_within and not bounded < objective
    sums[OBJECTIVE] += bounded if bounded < objective else objective
    sums[RATIO] += ratio
    sums[CLIPPED] += 1.0 if abs(ratio - F(1.0)) > epsilon else 0.0
    return -objective if has_slope else F(0.0)


@exact
def _regularize(
    first: KernelInput,
    targets: LossTargets,
    options: LossOptions,
    row: int,
    velocity: Any,
    grads: Any,
    sums: NDArray[np.float64],
) -> None:
    """Add a row's change of the velocity and its Brownian regularizer, with the gradient."""
    scores = targets.scores[row]
    score, of_velocity, of_point = scores[0], scores[1], scores[2]
    weight, change = F(1.0) if options.sums_dimensions else F(1.0) / F(velocity.size), F(0.0)
    slope = F(2.0 * options.brownian_coef) * weight / F(first.points.shape[0])
    for i in range(velocity.size):
        reference = targets.reference_velocity[row, i]
        change += (velocity[i] - reference) * (velocity[i] - reference)
        score_term = of_point * first.points[row, i] - of_velocity * reference
        eta = (score * velocity[i] - score_term) / targets.latent_std[i]
        sums[BROWNIAN] += weight * eta * eta
        if slope != F(0.0):  # eta may be infinite
            grads[i] += slope * score * eta / targets.latent_std[i]
    sums[CHANGE] += math.sqrt(change)
