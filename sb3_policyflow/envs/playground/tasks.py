"""Finding MuJoCo Playground and its tasks, and saying in a sentence what is missing."""

from __future__ import annotations

import difflib
import importlib.metadata
import re
import subprocess
from typing import TYPE_CHECKING

from gymnasium.error import DependencyNotInstalled, NameNotFound

from sb3_policyflow.envs.extras import import_extra
from sb3_policyflow.envs.task_names import PLAYGROUND

if TYPE_CHECKING:
    from sb3_policyflow.envs.playground.batch import Overrides, PlaygroundBatch

OLDEST_VERSION = (0, 2)


def require_task(task: str) -> None:
    """Import MuJoCo Playground and look for a task.

    :raises DependencyNotInstalled: if it is missing, too old, or does not work here
    :raises NameNotFound: if it has no such task; with the nearest names
    """
    _require_playground(f"{PLAYGROUND}{task}-v0")
    from sb3_policyflow.envs.playground.batch import all_tasks

    names = all_tasks()
    if task not in names:
        nearest = difflib.get_close_matches(task, names, n=3, cutoff=0.4)
        advice = f"nearest: {', '.join(nearest)}" if nearest else f"it has {', '.join(names)}"
        raise NameNotFound(f"MuJoCo Playground has no task {task!r}; {advice}.")


def _require_playground(env_id: str) -> None:
    """Look at the version first: an old one may fail when it is imported, and say little."""
    try:
        version = importlib.metadata.version("playground")
    except importlib.metadata.PackageNotFoundError:
        version = None  # missing, or a checkout on the path
    if version and tuple(map(int, re.findall(r"\d+", version)[:2])) < OLDEST_VERSION:
        oldest = ".".join(map(str, OLDEST_VERSION))
        raise DependencyNotInstalled(
            f"{env_id} needs playground {oldest} or newer, and {version} is installed: "
            "pip install --upgrade 'sb3-policyflow[playground]'"
        )
    import_extra("mujoco_playground", "playground", env_id)


def load_task(
    task: str, num_envs: int, max_episode_steps: int | None, overrides: Overrides | None
) -> PlaygroundBatch:
    """A batch of environments of a task.

    :raises DependencyNotInstalled: if Playground, or the robots of the task, cannot be had
    :raises NameNotFound: if there is no such task
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
    """Whether git failed or is missing, or its clone of mujoco_menagerie is not whole."""
    if isinstance(error, subprocess.CalledProcessError):
        return True
    return error.filename == "git" or "mujoco_menagerie" in str(error.filename)
