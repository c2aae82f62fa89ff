"""Parts that are chosen by a name."""

from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")


def choose(option: str, name: object, choices: Mapping[str, T]) -> T:
    """Look ``name`` up among ``choices``.

    >>> choose("solver", "euler", {"euler": 1, "heun": 2})
    1
    >>> choose("solver", "newton", {"euler": 1, "heun": 2})
    Traceback (most recent call last):
    ...
    ValueError: solver must be one of 'euler', 'heun', got 'newton'.

    :param option: The option that is being chosen, for the error message.
    :param name: The name that the user gave.
    :param choices: The choices, by name.
    :return: The choice of that name.
    :raises ValueError: If there is none of that name.
    """
    if not isinstance(name, str) or name not in choices:
        known = ", ".join(repr(choice) for choice in choices)
        raise ValueError(f"{option} must be one of {known}, got {name!r}.")
    return choices[name]
