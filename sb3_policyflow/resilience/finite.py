"""Numbers that are not finite, found before they reach the parameters."""

from collections.abc import Sequence

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer


def check_finite(
    values: np.ndarray,
    what: str,
    timestep: int,
    advice: str,
    environments: Sequence[int] | None = None,
) -> None:
    """Stop at a number that is not finite.

    >>> check_finite(np.array([1.0, np.nan]), "The reward", 6, "mend the environment")
    Traceback (most recent call last):
    ...
    FloatingPointError: The reward is not finite at timestep 6, in environment 1. \
Training has stopped before its parameters were touched, and the model can be saved: mend the \
environment.

    :param values: One row for each environment, shape (n, ...).
    :param what: The beginning of the sentence.
    :param timestep: When, for the message.
    :param advice: What to do.
    :param environments: Which environments the rows are of, if not all of them.
    :raises FloatingPointError: With the first environment concerned.
    """
    if np.isfinite(values).all():
        return
    row = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))[0]
    environment = row if environments is None else environments[row]
    raise FloatingPointError(
        f"{what} is not finite at timestep {timestep}, in environment {environment}. "
        "Training has stopped before its parameters were touched, and the model can be saved: "
        f"{advice}."
    )


def check_rollout(buffer: RolloutBuffer, first_timestep: int) -> None:
    """Stop at actions, values or advantages of a complete rollout that are not finite.

    The environment has seen the actions clipped to their bounds.

    :param buffer: The rollout, with arrays of shape (n_steps, n_envs, ...).
    :param first_timestep: Timesteps before it.
    :raises FloatingPointError: With the first step and environment concerned.
    """
    advice = "lower the learning rate, and normalize observations and rewards with VecNormalize"
    for name in ("actions", "values", "advantages", "returns"):
        array = getattr(buffer, name)
        if not np.isfinite(array).all():
            finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
            step = np.flatnonzero(~finite)[0]
            timestep = first_timestep + (int(step) + 1) * buffer.n_envs
            what = f"One of the rollout's {name}"
            check_finite(array[step], what, timestep, advice)
