"""Registration of this package's environments with Gymnasium."""

from typing import Any

import gymnasium as gym

from sb3_policyflow.envs.extras import import_extra
from sb3_policyflow.envs.playground.tasks import require_task
from sb3_policyflow.envs.task_names import (
    OTHER_PLAYGROUND_TASKS,
    PLAYGROUND,
    PLAYGROUND_TASKS,
)

_ROBOTICS = ("Adroit", "AntMaze", "Fetch", "Franka", "Hand", "PointMaze")
"""Beginnings of gymnasium-robotics' environment ids."""


def register() -> None:
    """Register this package's environments with Gymnasium; calling it again changes nothing.

    Entry points are strings, so nothing is imported before an environment is made.
    """
    _register(
        "MultiGoal-v0",
        entry_point="sb3_policyflow.envs.multigoal:MultiGoalEnv",
        vector_entry_point="sb3_policyflow.envs.multigoal:MultiGoalVectorEnv",
        max_episode_steps=50,
    )
    _register(
        "PointMazeMultiGoal-Medium-v0",
        entry_point="sb3_policyflow.envs.point_maze:PointMazeMultiGoalEnv",
        max_episode_steps=600,
    )
    for task in PLAYGROUND_TASKS + OTHER_PLAYGROUND_TASKS:
        _register_playground(task)


def ensure_registered(env_id: str) -> None:
    """Register an environment that this package knows of, if it is not registered yet.

    Call it before ``gymnasium.make`` where an id comes from a user: it imports gymnasium-robotics
    for its ids, and registers a task that has been added to MuJoCo Playground as
    ``Playground/NAME-v0``. Other ids are left to ``gymnasium.make``, whose error names the nearest
    ones.

    :param env_id: for instance ``PointMaze_Medium_Diverse_GDense-v3``, ``Playground/MyTask-v0``
    :raises DependencyNotInstalled: if the package that has it is missing or does not work
    :raises NameNotFound: if MuJoCo Playground has no such task
    """
    if env_id in gym.registry:
        return
    if env_id.startswith(PLAYGROUND):
        task = env_id.removeprefix(PLAYGROUND).removesuffix("-v0")
        require_task(task)
        _register_playground(task)
    elif env_id.startswith(_ROBOTICS):
        import_extra("gymnasium_robotics", "robotics", env_id)


def _register(env_id: str, **options: Any) -> None:
    """Register an environment, unless there is one of this id."""
    if env_id not in gym.registry:
        gym.register(env_id, **options)


def _register_playground(task: str) -> None:
    _register(
        f"{PLAYGROUND}{task}-v0",
        entry_point="sb3_policyflow.envs.playground:PlaygroundEnv",
        vector_entry_point="sb3_policyflow.envs.playground:PlaygroundVectorEnv",
        kwargs={"task": task},
    )
