"""Gradients clipped, and steps of Adam taken, by kernels."""

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

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


class _AdamReading(NamedTuple):
    """Tensors of a group that a kernel can work on, and where they were when that was checked."""

    tensors: list[th.Tensor]
    places: list[int]


_readings: WeakKeyDictionary[th.optim.Optimizer, list[_AdamReading]] = WeakKeyDictionary()


def step_in_place(optimizer: th.optim.Optimizer) -> bool:
    """Take a step of Adam or AdamW, in the state that torch's own step has made and goes on with.

    :param optimizer: The optimizer, whose parameters have gradients.
    :return: Whether it was taken; if not, nothing is done, and ``optimizer.step()`` can do it.
    """
    kernels = load_kernels()
    if isinstance(kernels, str) or why_torch_must_work() or _has_more_to_do(optimizer):
        return False
    found = [_adam_tensors(optimizer, group) for group in optimizer.param_groups]
    groups = [tensors for tensors in found if tensors is not None]
    if len(groups) < len(found):
        return False
    readings = [_AdamReading(tensors, [t.data_ptr() for t in tensors]) for tensors in groups]
    if not _are_known(optimizer, readings):
        if not all(are_usable(reading.tensors) for reading in readings):
            return False
        _readings[optimizer] = readings
    for group, reading in zip(optimizer.param_groups, readings, strict=True):
        gradients = [p.grad for p in group["params"] if p.grad is not None]
        if not are_usable(gradients):
            return False
        _take_step(kernels, group, gradients, reading.places)
    return True


def _are_known(optimizer: th.optim.Optimizer, readings: list[_AdamReading]) -> bool:
    """Whether all tensors, and their memory, are those that were checked before."""
    known = _readings.get(optimizer, [])
    return len(known) == len(readings) and all(
        old.places == new.places and all(map(operator.is_, old.tensors, new.tensors))
        for old, new in zip(known, readings, strict=True)
    )


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


def _adam_tensors(optimizer: Any, group: dict[str, Any]) -> list[th.Tensor] | None:
    """Parameters with gradients, both moments and steps of a group; None if there are none yet."""
    numbers = (group["lr"], *group["betas"])
    has_numbers = all(isinstance(number, float | int) for number in numbers)
    if not has_numbers or any(group[name] != value for name, value in PLAIN_ADAM.items()):
        return None
    parameters = [p for p in group["params"] if p.grad is not None]
    states = [optimizer.state.get(parameter) for parameter in parameters]
    if not all(states):
        return None
    kinds = ("exp_avg", "exp_avg_sq", "step")
    return [*parameters, *(state[kind] for kind in kinds for state in states)]


def _take_step(
    kernels: Kernels, group: dict[str, Any], gradients: list[th.Tensor], places: list[int]
) -> None:
    beta1, beta2 = group["betas"]
    options = AdamOptions(
        float(group["lr"]),
        float(beta1),
        float(beta2),
        float(group["eps"]),
        float(group["weight_decay"]),
        bool(group.get("decoupled_weight_decay", False)),
    )
    table = np.array([*(grad.data_ptr() for grad in gradients), *places])
    sizes = np.array([grad.numel() for grad in gradients])
    kernels.adam(table.reshape(5, -1), sizes, options)
