"""Coefficients that change while training goes on."""

import re

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

Coefficient = float | str | Schedule
"""A constant, a string such as "lin_0.25", or a function of the remaining progress."""

_LINEAR = re.compile(r"lin_(?P<start>[^_]+)(_(?P<end>[^_]+))?")


def parse_schedule(name: str, value: Coefficient) -> FloatSchedule:
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
    start, end = _ends(name, value)
    if not (0.0 <= start < float("inf") and 0.0 <= end < float("inf")):
        raise ValueError(f"{name} must not be negative nor infinite, got {value!r}.")
    constant = start == end
    return FloatSchedule(ConstantSchedule(start) if constant else LinearSchedule(start, end, 1.0))


def _ends(name: str, value: float | str) -> tuple[float, float]:
    """First and last value of a constant or linear schedule."""
    try:
        linear = _LINEAR.fullmatch(value) if isinstance(value, str) else None
        if linear is None:
            return float(value), float(value)
        return float(linear["start"]), float(linear["end"] or 0.0)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be a number, a string such as 'lin_0.25' or 'lin_0.25_0.05', or a "
            f"function of the remaining progress, got {value!r}."
        ) from None
