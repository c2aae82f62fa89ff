"""Numbers that are not finite, found before they reach the parameters."""

import math
from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer


class NotFiniteError(FloatingPointError, ValueError):
    """A number is not finite. SB3's PPO raises a ``ValueError`` for actions of this kind."""


def check_finite(
    values: np.ndarray,
    what: str,
    timestep: int,
    advice: str,
    environments: Sequence[int] | None = None,
) -> None:
    """Stop at a number that is not finite.

    >>> try:
    ...     check_finite(np.array([1.0, np.nan]), "The reward", 6, "fix the environment")
    ... except NotFiniteError as error:
    ...     str(error)[:62]
    'The reward is not finite at timestep 6, in environment 1. Trai'

    :param values: One row for each environment, shape (n, ...).
    :param what: The beginning of the sentence.
    :param timestep: When, for the message.
    :param advice: What to do.
    :param environments: Which environments the rows are of, if not all of them.
    :raises NotFiniteError: With the first environment concerned.
    """
    if np.isfinite(values).all():
        return
    row = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))[0]
    environment = row if environments is None else environments[row]
    raise NotFiniteError(
        f"{what} is not finite at timestep {timestep}, in environment {environment}. "
        "Training has stopped before its parameters were touched, and the model can be saved: "
        f"{advice}."
    )


def all_finite(values: th.Tensor) -> bool:
    """Whether no number is infinite or NaN.

    >>> all_finite(th.tensor([1.0, 2.0])), all_finite(th.tensor([1.0, th.inf]))
    (True, False)
    """
    # The sum of finite numbers is finite but for overflow, and takes less time.
    return math.isfinite(values.sum()) or bool(values.isfinite().all())


def check_actions(actions: th.Tensor) -> None:
    """Stop at an action that is not finite, as SB3's PPO does before anything acts on it.

    :param actions: Shape (n, dim).
    :raises NotFiniteError: With the first observation concerned.
    """
    if not all_finite(actions):
        row = int((~actions.isfinite()).any(dim=-1).nonzero()[0])
        raise NotFiniteError(
            f"The policy's action is not finite, for observation {row} of the batch: look for "
            "such numbers in observation and parameters, or load an earlier checkpoint."
        )


def check_rollout(buffer: RolloutBuffer, first_timestep: int) -> None:
    """Stop at actions, values or advantages of a complete rollout that are not finite.

    The environment has seen the actions clipped to their bounds.

    :param buffer: The rollout, with arrays or tensors of shape (n_steps, n_envs, ...).
    :param first_timestep: Timesteps before it.
    :raises FloatingPointError: With the first step and environment concerned.
    """
    advice = "lower the learning rate, and normalize observations and rewards with VecNormalize"
    for name in ("actions", "values", "advantages", "returns"):
        values = getattr(buffer, name)
        if isinstance(values, np.ndarray):
            values = th.from_numpy(values)  # on the CPU, whatever torch's default device is
        if not all_finite(values):
            array = values.cpu().numpy()
            finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
            step = np.flatnonzero(~finite)[0]
            timestep = first_timestep + (int(step) + 1) * buffer.n_envs
            what = f"One of the rollout's {name}"
            check_finite(array[step], what, timestep, advice)
