"""Resuming from a saved model, with its own hyperparameters and normalization statistics."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.integrations.isaaclab.lab import LabError
from sb3_policyflow.policyflow import PolicyFlow
from sb3_policyflow.resilience.files import saved_model
from sb3_policyflow.resilience.normalization import read_statistics
from sb3_policyflow.resilience.saving import ResumeState

FOR_THE_SCRIPT = ("n_steps", "timeout_bootstrap", "seed")
"""Hyperparameters that decide how the environment is made, and for how long to train."""


class Checkpoint(NamedTuple):
    """What a run resumes from.

    ``hyperparameters`` are those that :data:`FOR_THE_SCRIPT` names. ``statistics`` have no
    environment yet, and are None if the model was trained without ``VecNormalize``.
    """

    path: Path
    hyperparameters: dict[str, Any]
    statistics: VecNormalize | None


def read_checkpoint(path: Path, overrides: Sequence[str]) -> Checkpoint:
    """Check that training can resume from a model, before the simulator starts.

    :param path: Its file, whose name may be given without its ``.zip``.
    :param overrides: What the command line changes in IsaacLab's configuration.
    :raises LabError: If it or its statistics cannot be loaded, or its hyperparameters are to be
        changed.
    """
    path = _found(path)
    changes = [change for change in overrides if _is_of_the_model(change)]
    if changes:
        raise LabError(
            "A model that is resumed has its own hyperparameters: leave out "
            f"{', '.join(changes)}, or --checkpoint."
        )
    with _refused_if_unreadable(path):
        model = PolicyFlow.load(path, device="cpu")
        data, _, _ = load_from_zip_file(path, device="cpu")
    hyperparameters = {name: getattr(model, name) for name in FOR_THE_SCRIPT}
    return Checkpoint(path, hyperparameters, _read_statistics(path, data or {}))


def _found(path: Path) -> Path:
    """The file of a saved model.

    :raises LabError: If there is none.
    """
    file = saved_model(path)
    if not file.is_file():
        raise LabError(f"There is no model {path} to resume from: correct --checkpoint.")
    return file


def _is_of_the_model(override: str) -> bool:
    """Whether it changes a hyperparameter of the model, which ``n_timesteps`` is not.

    Version 3 of IsaacLab can also replace all of them at once.

    >>> [_is_of_the_model(o) for o in ("++agent.gamma=0.9", "agent.n_timesteps=9", "env.x=1")]
    [True, False, False]
    >>> _is_of_the_model("agent=large")
    True
    """
    name = override.lstrip("+~").partition("=")[0]
    return name.partition(".")[0] == "agent" and name != "agent.n_timesteps"


@contextmanager
def _refused_if_unreadable(path: Path) -> Iterator[None]:
    """Turn an error into one line: files hold pickles, which may raise any exception."""
    try:
        yield
    except Exception as error:
        reason = str(error).partition("\n")[0]
        raise LabError(f"{path} cannot be resumed: {reason}") from error


def _read_statistics(checkpoint: Path, data: dict[str, Any]) -> VecNormalize | None:
    """The statistics saved with a model, if it was trained with ``VecNormalize``.

    The model says whether it was: a file beside it may be of an earlier run, or get lost.

    :param checkpoint: The model's file.
    :param data: Its content.
    :raises LabError: If statistics are missing, or cannot be loaded.
    """
    path = statistics_of(checkpoint)
    state: ResumeState | None = data.get("resume_state")
    # A user may have left the state out with SB3's ``exclude``; then the file beside it decides.
    if not (path.is_file() if state is None else state.normalized_returns is not None):
        return None
    if not path.is_file():
        raise LabError(
            f"{checkpoint} was trained with VecNormalize, but its statistics are not at {path}: "
            "copy them there."
        )
    try:
        return read_statistics(path)
    except ValueError as error:
        raise LabError(str(error)) from error


def statistics_of(checkpoint: Path) -> Path:
    """The file of the ``VecNormalize`` statistics that were saved with a model.

    >>> statistics_of(Path("logs/model_98304_steps.zip")).name
    'model_vecnormalize_98304_steps.pkl'
    >>> [statistics_of(Path(name)).name for name in ("logs/model.zip", "logs/model_0.5")]
    ['model_vecnormalize.pkl', 'model_0.5_vecnormalize.pkl']
    """
    model = checkpoint.name.removesuffix(".zip")
    name = re.sub(r"(_\d+_steps)?$", r"_vecnormalize\1", model, count=1)
    return checkpoint.with_name(f"{name}.pkl")
