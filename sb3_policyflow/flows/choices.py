"""Parts that are chosen by a name."""

from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")


def choose(what: str, name: str, choices: Mapping[str, T]) -> T:
    """Look ``name`` up among ``choices``.

    >>> choose("solver", "euler", {"euler": 1, "heun": 2})
    1
    >>> choose("solver", "newton", {"euler": 1, "heun": 2})
    Traceback (most recent call last):
    ...
    ValueError: Unknown solver 'newton': choose one of 'euler', 'heun'.

    :param what: What is being chosen, for the error message.
    :param name: The name that the user gave.
    :param choices: What there is, by name.
    :return: The choice of that name.
    :raises ValueError: If there is none of that name.
    """
    try:
        return choices[name]
    except (KeyError, TypeError):
        known = ", ".join(repr(choice) for choice in choices)
        raise ValueError(f"Unknown {what} {name!r}: choose one of {known}.") from None
