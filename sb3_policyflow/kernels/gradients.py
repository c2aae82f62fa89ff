"""Gradients clipped, and steps of Adam taken, by kernels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from sb3_policyflow.kernels.compiler import load_kernels
from sb3_policyflow.kernels.inspection import addresses, are_usable, why_torch_must_work
from sb3_policyflow.kernels.layouts import AdamOptions, Kernels

PLAIN_ADAM = {"amsgrad": False, "maximize": False, "capturable": False, "differentiable": False}
"""Options of torch's Adam that the kernel knows by their defaults only."""


def clip_gradients_in_place(grads: Sequence[th.Tensor], max_norm: float) -> float | None:
    """Scale gradients to a Euclidean norm of all together, if theirs is finite and greater.

    :param grads: The gradients.
    :param max_norm: The norm; infinity to leave them alone.
    :return: The norm that they had, or None, and nothing done, where kernels cannot work.
    """
    kernels = load_kernels()
    if isinstance(kernels, str) or why_torch_must_work() or not are_usable(grads):
        return None
    sizes = np.array([grad.numel() for grad in grads])
    return float(kernels.clip(addresses(grads), sizes, max_norm))


def step_in_place(optimizer: th.optim.Optimizer) -> bool:
    """Take a step of Adam or AdamW, in the state that torch's own step has made and goes on with.

    :param optimizer: The optimizer, whose parameters have gradients.
    :return: Whether it was taken; if not, nothing is done, and ``optimizer.step()`` can do it.
    """
    kernels = load_kernels()
    if isinstance(kernels, str) or why_torch_must_work() or _has_more_to_do(optimizer):
        return False
    groups = [_adam_tensors(optimizer, group) for group in optimizer.param_groups]
    if any(tensors is None for tensors in groups):
        return False
    for group, tensors in zip(optimizer.param_groups, groups, strict=True):
        if tensors:
            _take_step(kernels, group, tensors)
    return True


def _has_more_to_do(optimizer: Any) -> bool:
    """Whether a step is not only that of Adam: of a subclass, with hooks, or watched."""
    hooks = (
        optimizer._optimizer_step_pre_hooks,
        optimizer._optimizer_step_post_hooks,
        _global_optimizer_pre_hooks,
        _global_optimizer_post_hooks,
    )
    is_adam = type(optimizer) in (th.optim.Adam, th.optim.AdamW)
    # Schedulers of torch count the calls of step, with one of their own.
    return not is_adam or any(hooks) or "step" in optimizer.__dict__


def _adam_tensors(optimizer: Any, group: dict[str, Any]) -> list[list[th.Tensor]] | None:
    """Gradients, parameters, both moments and steps of a group; None if kernels cannot work."""
    numbers = (group["lr"], *group["betas"])
    has_numbers = all(isinstance(number, float | int) for number in numbers)
    if not has_numbers or any(group[name] != value for name, value in PLAIN_ADAM.items()):
        return None
    rows = []
    for parameter in group["params"]:
        grad = parameter.grad
        if grad is not None:
            state = optimizer.state.get(parameter)
            if not state or grad.shape != parameter.shape:
                return None
            rows.append((grad, parameter, state["exp_avg"], state["exp_avg_sq"], state["step"]))
    tensors = [list(column) for column in zip(*rows, strict=True)]
    return tensors if all(are_usable(column) for column in tensors) else None


def _take_step(kernels: Kernels, group: dict[str, Any], tensors: list[list[th.Tensor]]) -> None:
    beta1, beta2 = group["betas"]
    options = AdamOptions(
        float(group["lr"]),
        float(beta1),
        float(beta2),
        float(group["eps"]),
        float(group["weight_decay"]),
        bool(group.get("decoupled_weight_decay", False)),
    )
    places = np.array([addresses(column) for column in tensors])
    sizes = np.array([parameter.numel() for parameter in tensors[1]])
    kernels.adam(places, sizes, options)
