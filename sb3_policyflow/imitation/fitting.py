"""Whether demonstrations are of a model's environment."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_policyflow.imitation.demonstrations import Demonstrations, Observations

CHECKED_VALUES = 100
"""Discrete observations that are looked at."""


def check_spaces(shown: Demonstrations, model: Any) -> None:
    """Refuse demonstrations that a model could not have made.

    :param shown: The demonstrations.
    :param model: An SB3 algorithm.
    :raises ValueError: With both spaces.
    """
    pairs = (
        ("observations", shown.observations, shown.observation_space, model.observation_space),
        ("actions", shown.actions, shown.action_space, model.action_space),
    )
    for name, values, space, wanted in pairs:
        if _fits(values, space, wanted, has_bounds=name == "actions"):
            continue
        theirs = space or _described(values)
        raise ValueError(
            f"The demonstrations do not fit the model: their {name} are {theirs}, the model's are "
            f"{wanted}. Use demonstrations of the environment that the model is made for, with the "
            "same wrappers."
        )


def _described(values: Observations) -> str:
    if isinstance(values, dict):
        return str({key: _described(part) for key, part in values.items()})
    return f"arrays of shape {values.shape[1:]} and dtype {values.dtype}"


def _fits(
    values: Observations,
    space: spaces.Space[Any] | None,
    wanted: spaces.Space[Any],
    has_bounds: bool,
) -> bool:
    """Whether values, and their space if it is known, are those of another space."""
    if isinstance(wanted, spaces.Dict):
        if not isinstance(values, dict) or values.keys() != wanted.spaces.keys():
            return False
        parts: Any = space.spaces if isinstance(space, spaces.Dict) else dict.fromkeys(values)
        return all(_fits(values[key], parts.get(key), wanted[key], has_bounds) for key in values)
    if isinstance(values, dict):
        return False
    if isinstance(wanted, spaces.Box):
        return _fits_box(values, space, wanted, has_bounds)
    shaped = values.reshape(len(values), *(wanted.shape or ())).astype(wanted.dtype)
    return space in (None, wanted) and all(map(wanted.contains, shaped[:CHECKED_VALUES]))


def _fits_box(
    values: np.ndarray, space: spaces.Space[Any] | None, wanted: spaces.Box, has_bounds: bool
) -> bool:
    if space is not None and not isinstance(space, spaces.Box):
        return False
    shapes = [wanted.shape]
    if is_image_space(wanted, check_channels=True):
        # SB3 puts the channels of images first, and those of demonstrations where they are needed.
        shapes.append((*wanted.shape[1:], wanted.shape[0]))
    # Images are divided by 255 if they are bytes.
    are_bytes = [dtype == np.uint8 for dtype in (values.dtype, wanted.dtype)]
    if values.shape[1:] not in shapes or are_bytes[0] != are_bytes[1]:
        return False
    if space is None or not has_bounds:
        return True
    bounds = [(box.low, box.high) for box in (space, wanted)]
    return space.shape == wanted.shape and np.allclose(bounds[0], bounds[1])
