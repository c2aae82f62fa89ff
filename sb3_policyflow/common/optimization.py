"""Optimizers and gradients, with little to do between their large operations."""

import math
from collections.abc import Iterable
from typing import Any

import torch as th

from sb3_policyflow.kernels import clip_gradients_in_place


def make_optimizer(
    optimizer_class: type[th.optim.Optimizer],
    parameters: Iterable[th.nn.Parameter],
    learning_rate: float,
    options: dict[str, Any],
) -> th.optim.Optimizer:
    """An optimizer, in its fused implementation if it has one and the user does not choose.

    >>> make_optimizer(th.optim.Adam, [th.nn.Parameter(th.ones(1))], 1e-3, {}).defaults["fused"]
    True

    :param optimizer_class: Its class.
    :param parameters: What it optimizes.
    :param learning_rate: Its learning rate.
    :param options: Its other arguments.
    """
    arguments = {"lr": learning_rate, **options}
    is_open = not {"fused", "foreach", "capturable", "differentiable"} & options.keys()
    if optimizer_class in (th.optim.Adam, th.optim.AdamW) and is_open:
        parameters = list(parameters)
        try:
            return optimizer_class(parameters, fused=True, **arguments)
        except RuntimeError:
            pass  # torch has no such implementation for this device
    return optimizer_class(parameters, **arguments)


def clip_gradients(parameters: Iterable[th.nn.Parameter], max_norm: float = math.inf) -> float:
    """Scale the gradients to a Euclidean norm of all together, if theirs is greater.

    Gradients that are not finite are left alone.

    :param parameters: Parameters, at least one with a gradient.
    :param max_norm: The norm.
    :return: The norm that they had.
    """
    grads = [p.grad for p in parameters if p.grad is not None]
    norm = clip_gradients_in_place(grads, max_norm)
    if norm is not None:
        return norm
    norm = float(th.cat([grad.reshape(-1) for grad in grads]).norm())
    factor = max_norm / (norm + 1e-6)
    if factor < 1 and math.isfinite(norm):
        th._foreach_mul_(grads, factor)
    return norm
