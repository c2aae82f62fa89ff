"""Gradients clipped, and steps of Adam taken, by kernels."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch as th
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from sb3_policyflow.kernels.compiler import load_kernels
from sb3_policyflow.kernels.inspection import addresses, are_usable, why_torch_must_work
from sb3_policyflow.kernels.layouts import AdamOptions, Integers

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


@dataclass(frozen=True)
class _AdamReading:
    """Tensors that a step takes of a group, and where they were when they were checked.

    ``tensors`` are its n parameters with a gradient, then their first moments, second moments and
    numbers of steps.
    """

    tensors: list[th.Tensor]
    places: list[int]

    @cached_property
    def addresses(self) -> Integers:
        """Where they are, shape (4, n)."""
        return np.array(self.places, dtype=np.int64).reshape(4, -1)

    @cached_property
    def sizes(self) -> Integers:
        """How many numbers each of the n parameters has."""
        parameters = self.tensors[: len(self.tensors) // 4]
        return np.array([parameter.numel() for parameter in parameters], dtype=np.int64)

    def is_same(self, other: "_AdamReading") -> bool:
        """Whether another reading is of these tensors in the same memory."""
        is_known = self.places == other.places and len(self.tensors) == len(other.tensors)
        return is_known and all(map(operator.is_, self.tensors, other.tensors))


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
    gradients = [
        [p.grad for p in group["params"] if p.grad is not None] for group in optimizer.param_groups
    ]
    readings = _checked_readings(optimizer, groups)
    if readings is None or not all(map(are_usable, gradients)):
        return False
    for group, grads, reading in zip(optimizer.param_groups, gradients, readings, strict=True):
        table = np.concatenate((addresses(grads)[None], reading.addresses))
        kernels.adam(table, reading.sizes, _adam_options(group))
    return True


def _checked_readings(
    optimizer: th.optim.Optimizer, groups: list[list[th.Tensor]]
) -> list[_AdamReading] | None:
    """The readings of an optimizer's groups, or None if kernels cannot work on them.

    :param optimizer: The optimizer.
    :param groups: The tensors of each group.
    """
    readings = [_AdamReading(tensors, [t.data_ptr() for t in tensors]) for tensors in groups]
    known = _readings.get(optimizer, [])
    if len(known) == len(readings) and all(map(_AdamReading.is_same, known, readings)):
        return known
    if not all(are_usable(reading.tensors) for reading in readings):
        return None
    _readings[optimizer] = readings
    return readings


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
    """Parameters with gradients, both moments and steps of a group.

    None if there are none yet, or if it has options that the kernel does not know.
    """
    numbers = (group["lr"], *group["betas"])
    has_numbers = all(isinstance(number, float | int) for number in numbers)
    if not has_numbers or any(group[name] != value for name, value in PLAIN_ADAM.items()):
        return None
    parameters = [p for p in group["params"] if p.grad is not None]
    states = [optimizer.state.get(parameter) for parameter in parameters]
    if not all(states):
        return None
    kinds = ("exp_avg", "exp_avg_sq", "step")
    moments = (state[kind] for kind in kinds for state in states)
    return [*parameters, *moments]


def _adam_options(group: dict[str, Any]) -> AdamOptions:
    beta1, beta2 = group["betas"]
    return AdamOptions(
        float(group["lr"]),
        float(beta1),
        float(beta2),
        float(group["eps"]),
        float(group["weight_decay"]),
        bool(group.get("decoupled_weight_decay", False)),
    )
