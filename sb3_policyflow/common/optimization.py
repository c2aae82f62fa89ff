"""The optimizer of a policy, and a step of it."""

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple

import torch as th

from sb3_policyflow.kernels import clip_gradients_in_place, step_in_place


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


def clip_gradients(parameters: Iterable[th.nn.Parameter], max_norm: float | None = None) -> float:
    """Scale the gradients to a Euclidean norm of all together, if theirs is greater.

    Gradients that are not finite are left alone.

    :param parameters: Parameters, at least one with a gradient.
    :param max_norm: The norm; no bound if None or not positive.
    :return: The norm that they had.
    """
    max_norm = max_norm if max_norm is not None and max_norm > 0 else math.inf
    grads = [p.grad for p in parameters if p.grad is not None]
    norm = clip_gradients_in_place(grads, max_norm)
    if norm is not None:
        return norm
    norm = float(th.cat([grad.reshape(-1) for grad in grads]).norm())
    factor = max_norm / (norm + 1e-6)
    if factor < 1 and math.isfinite(norm):
        th._foreach_mul_(grads, factor)
    return norm


class OwnRate(NamedTuple):
    """A learning rate of their own for some of an optimizer's parameters."""

    parameters: frozenset[th.nn.Parameter]
    learning_rate: float


def take_step(optimizer: th.optim.Optimizer, own_rate: OwnRate | None = None) -> None:
    """Take a step of an optimizer, in one call of a kernel if it is plain Adam on a CPU.

    :param optimizer: The optimizer.
    :param own_rate: For those of its parameters that have a learning rate of their own.
    """
    with nullcontext() if own_rate is None else _apart(optimizer, own_rate):
        if not step_in_place(optimizer):
            optimizer.step()


@contextmanager
def _apart(optimizer: th.optim.Optimizer, own_rate: OwnRate) -> Iterator[None]:
    """A block in which parameters with a rate of their own are a group of the optimizer.

    They are no longer than that, so that its state is laid out as ever.
    """
    groups = optimizer.param_groups
    optimizer.param_groups = []
    for group in groups:
        own = [parameter for parameter in group["params"] if parameter in own_rate.parameters]
        others = [p for p in group["params"] if p not in own_rate.parameters]
        optimizer.param_groups += [
            {**group, "params": parameters, "lr": rate}
            for parameters, rate in ((others, group["lr"]), (own, own_rate.learning_rate))
            if parameters
        ]
    try:
        yield
    finally:
        optimizer.param_groups = groups


def check_step(loss: float, norm: float, num_timesteps: int, advice: str) -> None:
    """Refuse a step of the optimizer that would spoil the parameters.

    :param loss: The loss.
    :param norm: Euclidean norm of its gradient.
    :param num_timesteps: When, for the message.
    :param advice: What helps besides a lower learning rate, for the message.
    :raises FloatingPointError: If one of them is not finite.
    """
    if math.isfinite(loss) and math.isfinite(norm):
        return
    what = "gradient" if math.isfinite(loss) else "loss"
    raise FloatingPointError(
        f"The {what} is not finite (loss {loss}, {num_timesteps} timesteps). The parameters are "
        f"those of the last good step and can be saved: lower the learning rate{advice}."
    )
