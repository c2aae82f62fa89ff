"""Finds MuJoCo Playground and its tasks, or says in a sentence what is missing."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
from typing import TYPE_CHECKING

from gymnasium.error import DependencyNotInstalled, NameNotFound

from sb3_policyflow.envs.extras import import_extra
from sb3_policyflow.envs.task_names import PLAYGROUND
from sb3_policyflow.hints import did_you_mean, install_command

if TYPE_CHECKING:
    from sb3_policyflow.envs.playground.batch import Overrides, PlaygroundBatch

OLDEST_VERSION = (0, 2)


def require_task(task: str) -> None:
    """Import MuJoCo Playground and look for a task.

    :param task: Name of the task.
    :raises DependencyNotInstalled: If it is missing, too old, or does not work here.
    :raises NameNotFound: If it has no such task; with the nearest names.
    """
    _require_playground(f"{PLAYGROUND}{task}-v0")
    from sb3_policyflow.envs.playground.batch import all_tasks

    names = all_tasks()
    if task not in names:
        raise NameNotFound(f"MuJoCo Playground has no task {task!r}: {did_you_mean(task, names)}")


def _require_playground(env_id: str) -> None:
    """Check the version before the import, in which an old one may fail without saying why."""
    try:
        version = importlib.metadata.version("playground")
    except importlib.metadata.PackageNotFoundError:
        version = None  # Missing, or a checkout on the path.
    if version and tuple(map(int, re.findall(r"\d+", version)[:2])) < OLDEST_VERSION:
        oldest = ".".join(map(str, OLDEST_VERSION))
        raise DependencyNotInstalled(
            f"{env_id} needs playground {oldest} or newer, and {version} is installed: "
            f"run `{install_command('playground')}`"
        )
    import_extra("mujoco_playground", "playground", env_id)


def load_task(
    task: str, num_envs: int, max_episode_steps: int | None, overrides: Overrides | None
) -> PlaygroundBatch:
    """A batch of environments of a task.

    :param task: Name of the task.
    :param num_envs: Number of environments.
    :param max_episode_steps: Time limit; None for the task's ``episode_length``.
    :param overrides: Changes to the task's configuration, if any.
    :raises DependencyNotInstalled: If Playground or the robots of the task are missing and cannot
        be downloaded.
    :raises NameNotFound: If there is no such task.
    """
    require_task(task)
    from sb3_policyflow.envs.playground.batch import PlaygroundBatch

    try:
        return PlaygroundBatch(task, num_envs, max_episode_steps, overrides or {})
    except (OSError, subprocess.CalledProcessError) as error:
        if not _is_about_robots(error):
            raise
        raise DependencyNotInstalled(
            f"{PLAYGROUND}{task}-v0 needs the robots of mujoco_menagerie, which Playground clones "
            f"with git when such a task is first made, and that failed ({error}): try again with "
            "a connection to GitHub."
        ) from error


def _is_about_robots(error: OSError | subprocess.CalledProcessError) -> bool:
    """Whether git failed or is missing, or its clone of mujoco_menagerie is incomplete."""
    if isinstance(error, subprocess.CalledProcessError):
        return True
    return error.filename == "git" or "mujoco_menagerie" in str(error.filename)
