"""Registration of this package's environments with Gymnasium."""

from typing import Any

import gymnasium as gym

from sb3_policyflow.envs.extras import import_extra
from sb3_policyflow.envs.task_names import OTHER_PLAYGROUND_TASKS, PLAYGROUND, PLAYGROUND_TASKS

_ROBOTICS = ("Adroit", "AntMaze", "Fetch", "Franka", "Hand", "PointMaze")
"""What the ids of gymnasium-robotics' environments begin with."""


def register() -> None:
    """Register this package's environments with Gymnasium; calling it again changes nothing.

    Entry points are strings: a simulator is imported when one of its environments is made.
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

    Call it before ``gymnasium.make`` if an id comes from a user. It imports gymnasium-robotics for
    the ids of that package, and registers tasks that have been added to MuJoCo Playground as
    ``Playground/NAME-v0``. Other ids are left to ``gymnasium.make``, whose error suggests similar
    ones.

    :param env_id: For instance ``PointMaze_Medium_Diverse_GDense-v3``, ``Playground/MyTask-v0``.
    :raises DependencyNotInstalled: If the package that has it is missing or does not work.
    :raises NameNotFound: If MuJoCo Playground has no such task.
    """
    if env_id in gym.registry:
        return
    if env_id.startswith(PLAYGROUND):
        # What needs the extra "playground" is imported on demand.
        from sb3_policyflow.envs.playground.tasks import require_task

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
