"""Coefficients and learning rates that change during training."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_policyflow.common import checks

Coefficient = float | str | Schedule
"""A constant, a string such as "lin_0.25", or a function of the remaining progress."""

_LINEAR = re.compile(r"lin_(?P<start>[^_]+)(_(?P<end>[^_]+))?")


def parse_schedule(name: str, value: object) -> FloatSchedule:
    """Turn what the user gave for a coefficient into a function of the remaining progress.

    >>> parse_schedule("brownian_coef", "lin_0.25")(0.5)
    0.125
    >>> parse_schedule("brownian_coef", "lin_1_0.5")(0.0)  # falls to a floor
    0.5

    :param name: The coefficient's name, for error messages.
    :param value: A number that is not negative, "lin_START" (falls linearly to zero),
        "lin_START_END" (falls or rises linearly to END), or a function of the progress that
        remains (1 at the start, 0 at the end).
    :return: The coefficient as a function of the remaining progress.
    :raises ValueError: If the value is of another form, or negative.
    """
    if callable(value):
        return FloatSchedule(value)
    number: Any = value
    linear = _LINEAR.fullmatch(value) if isinstance(value, str) else None
    try:
        start = float(number if linear is None else linear["start"])
        end = start if linear is None else float(linear["end"] or 0.0)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be a number, a string such as 'lin_0.25' or 'lin_0.25_0.05', or a "
            f"function of the remaining progress, got {value!r}."
        ) from None
    if not (0.0 <= start < float("inf") and 0.0 <= end < float("inf")):
        raise ValueError(f"{name} must not be negative nor infinite, got {value!r}.")
    constant = start == end
    return FloatSchedule(ConstantSchedule(start) if constant else LinearSchedule(start, end, 1.0))


def is_zero(value: object) -> bool:
    """Whether a coefficient as :func:`parse_schedule` takes it is 0 throughout.

    >>> is_zero(0.0), is_zero("0"), is_zero("lin_0.1")
    (True, True, False)
    """
    if callable(value):
        return False
    schedule = parse_schedule("coefficient", value)
    return schedule(1.0) == schedule(0.0) == 0


def positive_at_first(name: str, value: object) -> None:
    """A coefficient as :func:`parse_schedule` takes it that is not zero at the start.

    :raises ValueError: If it is.
    """
    if not callable(value) and parse_schedule(name, value)(1.0) == 0:
        raise ValueError(f"{name} must be positive, got {value!r}: with 0 nothing could change.")


@dataclass(frozen=True)
class KLAdaptiveLearningRate:
    """Lowers the learning rate when the policy changes too much and raises it when too little.

    lr / factor if KL > margin * target,    lr * factor if KL < target / margin

    The rule of RSL-RL and skrl, on which the paper builds.

    >>> rule = KLAdaptiveLearningRate()
    >>> [round(rule.adapt(3e-4, kl, desired_kl=0.01), 7) for kl in (0.03, 0.01, 0.001)]
    [0.0002, 0.0003, 0.00045]

    :param interval: When the learning rate moves: after each "epoch" or "minibatch".
    :param window: Whether the divergence at the end of an epoch is the mean over this "epoch" or
        over the "update" so far. It has no meaning if the rate moves after each minibatch.
    :param factor: Factor by which the learning rate moves, greater than 1.
    :param margin: Factor by which the divergence may miss the target before the rate moves.
    :param bounds: Lowest and highest learning rate. A start outside the bounds is kept and may only
        move towards them.
    """

    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "interval": checks.one_of(("epoch", "minibatch")),
        "window": checks.one_of(("epoch", "update")),
        "factor": checks.greater_than(1.0),
        "margin": checks.between(1.0),
        "bounds": checks.positive_bounds,
    }

    interval: str = "epoch"
    window: str = "epoch"
    factor: float = 1.5
    margin: float = 2.0
    bounds: tuple[float, float] = (1e-6, 1e-2)

    def adapt(self, learning_rate: float, kl: float, desired_kl: float) -> float:
        """The learning rate after ``kl`` nats were measured where ``desired_kl`` were wanted."""
        # Where it starts beyond its bounds, they must not turn "lower" into "higher".
        lowest, highest = min(self.bounds[0], learning_rate), max(self.bounds[1], learning_rate)
        if kl > self.margin * desired_kl:
            return max(learning_rate / self.factor, lowest)
        if kl < desired_kl / self.margin:
            return min(learning_rate * self.factor, highest)
        return learning_rate


def check_lr_adaptation(name: str, options: Any) -> None:
    """Refuse options that :class:`KLAdaptiveLearningRate` cannot use.

    :param name: What the options are called, for error messages.
    :param options: A dictionary of its parameters, or None for the defaults.
    :raises ValueError: If an option is unknown or out of its range.
    """
    try:
        rule = KLAdaptiveLearningRate(**(options or {}))
    except TypeError as error:
        known = ", ".join(KLAdaptiveLearningRate.option_checks)
        raise ValueError(f"{name} must be a dictionary of {known}, got {options!r}.") from error
    try:
        checks.check_options(rule)
    except ValueError as error:
        raise ValueError(f"In {name}, {error}") from error


def check_desired_kl(desired_kl: Coefficient, learning_rate: object) -> None:
    """Refuse a divergence of 0 to start with, and a learning rate that changes beside it.

    :param desired_kl: The target of the adaptive learning rate.
    :param learning_rate: A number, or a function of the remaining progress.
    :raises ValueError: With what to use instead.
    """
    if parse_schedule("desired_kl", desired_kl)(1.0) == 0:
        raise ValueError(f"desired_kl must be positive or None, got {desired_kl}.")
    rate = parse_schedule("learning_rate", learning_rate)
    if rate(1.0) != rate(0.0):
        raise ValueError(
            "With desired_kl the learning rate follows the divergence of the policy: give the "
            "learning_rate that it starts with, not a schedule."
        )
