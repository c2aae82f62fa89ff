"""Options of cloning."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

from sb3_policyflow.common import checks
from sb3_policyflow.common.schedules import Coefficient, parse_schedule
from sb3_policyflow.hints import did_you_mean


@dataclass(frozen=True)
class CloningOptions:
    """How a policy is cloned, see :func:`~sb3_policyflow.imitation.clone`.

    >>> CloningOptions.of(gradient_steps=0)
    Traceback (most recent call last):
    ...
    ValueError: gradient_steps must be at least 1, and a whole number, got 0.
    """

    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "gradient_steps": checks.at_least(1),
        "batch_size": checks.at_least(1),
        "learning_rate": parse_schedule,
        "noise_std": checks.or_none(checks.positive),
        "validation_fraction": checks.between(0.0, 0.9),
        "eval_freq": checks.at_least(1),
        "patience": checks.or_none(checks.at_least(1)),
    }

    gradient_steps: int = 6000
    batch_size: int = 1024
    learning_rate: Coefficient = "lin_0.001"
    noise_std: float | None = None
    validation_fraction: float = 0.1
    eval_freq: int = 200
    patience: int | None = 15
    seed: int | None = None
    checkpoint: str | Path | None = None

    @classmethod
    def of(cls, **options: Any) -> "CloningOptions":
        """The options of these names.

        :raises TypeError: If there is none of a name.
        :raises ValueError: If one cannot be used.
        """
        known = [field.name for field in fields(cls)]
        for name in options.keys() - set(known):
            raise TypeError(f"clone has no argument {name!r}: {did_you_mean(name, known)}")
        made = cls(**options)
        checks.check_options(made)
        return made

    def settings(self) -> dict[str, Any]:
        """What a run must have in common with the one that it continues.

        A learning rate that is a function cannot be compared, and counts as None.
        """
        names = ("gradient_steps", "batch_size", "validation_fraction", "eval_freq", "seed")
        rate = None if callable(self.learning_rate) else self.learning_rate
        return {**{name: getattr(self, name) for name in names}, "learning_rate": rate}
