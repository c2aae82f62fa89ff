"""Optimisers and gradients, with little to do between their large operations."""

from collections.abc import Iterable
from typing import Any

import torch as th


def make_optimizer(
    optimizer_class: type[th.optim.Optimizer],
    parameters: Iterable[th.nn.Parameter],
    learning_rate: float,
    options: dict[str, Any],
) -> th.optim.Optimizer:
    """An optimiser, in its fused implementation if it has one and the user does not choose.

    >>> make_optimizer(th.optim.Adam, [th.nn.Parameter(th.ones(1))], 1e-3, {}).defaults["fused"]
    True

    :param optimizer_class: Its class.
    :param parameters: What it optimises.
    :param learning_rate: Its learning rate.
    :param options: Its other arguments.
    """
    arguments = {"lr": learning_rate, **options}
    is_open = not {"fused", "foreach", "capturable", "differentiable"} & options.keys()
    if optimizer_class in (th.optim.Adam, th.optim.AdamW) and is_open:
        parameters = list(parameters)
        try:
            return optimizer_class(parameters, fused=True, **arguments)  # type: ignore[call-arg]
        except RuntimeError:
            pass  # torch has no such implementation for this device
    return optimizer_class(parameters, **arguments)


def gradient_norm(parameters: Iterable[th.nn.Parameter]) -> th.Tensor:
    """Euclidean norm of all gradients together, a tensor without dimensions.

    :param parameters: Parameters, at least one with a gradient.
    """
    grads = [p.grad.reshape(-1) for p in parameters if p.grad is not None]
    return th.cat(grads).norm()


def scale_gradients(parameters: Iterable[th.nn.Parameter], factor: float) -> None:
    """Multiply all gradients."""
    th._foreach_mul_([p.grad for p in parameters if p.grad is not None], factor)
