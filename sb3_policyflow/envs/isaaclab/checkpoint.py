"""A model to go on from: it brings its own hyperparameters, and the statistics saved with it."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_policyflow.envs.isaaclab.lab import LabError
from sb3_policyflow.policyflow import PolicyFlow

FOR_THE_SCRIPT = ("n_steps", "gamma", "timeout_bootstrap", "seed")
"""Hyperparameters that decide how the environment is made, and for how long to train."""


def find_checkpoint(path: Path) -> Path:
    """The file of a saved model, whose name may be given without its ``.zip``.

    :raises LabError: If there is none.
    """
    for candidate in (path, path.with_name(f"{path.name}.zip")):
        if candidate.is_file():
            return candidate
    raise LabError(f"There is no model {path} to go on from: correct --checkpoint.")


def read_checkpoint(path: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """See whether a model can be gone on from, before the simulator starts.

    :param path: Its file.
    :param overrides: What the command line changes in IsaacLab's configuration.
    :return: Its hyperparameters that :data:`FOR_THE_SCRIPT` names.
    :raises LabError: If it cannot be loaded, or others of its hyperparameters are to be changed.
    """
    changes = [change for change in overrides if _is_of_the_model(change)]
    if changes:
        raise LabError(
            "A model that is gone on from has its own hyperparameters: leave out "
            f"{', '.join(changes)}, or --checkpoint."
        )
    try:
        model = PolicyFlow.load(path, device="cpu")
    except (OSError, ValueError) as error:
        raise LabError(f"{path} cannot be gone on from: {error}") from error
    return {name: getattr(model, name) for name in FOR_THE_SCRIPT}


def _is_of_the_model(override: str) -> bool:
    """Whether it changes a hyperparameter; how long to train is none of the model's.

    >>> [_is_of_the_model(o) for o in ("++agent.gamma=0.9", "agent.n_timesteps=9", "env.x=1")]
    [True, False, False]
    """
    name = override.lstrip("+~").partition("=")[0]
    return name.startswith("agent.") and name != "agent.n_timesteps"


def statistics_of(checkpoint: Path) -> Path:
    """Where the statistics of ``VecNormalize`` are that were saved with a model.

    >>> statistics_of(Path("logs/model_98304_steps.zip")).name
    'model_vecnormalize_98304_steps.pkl'
    >>> statistics_of(Path("logs/model.zip")).name
    'model_vecnormalize.pkl'
    """
    name = re.sub(r"(_\d+_steps)?$", r"_vecnormalize\1", checkpoint.stem, count=1)
    return checkpoint.with_name(f"{name}.pkl")
