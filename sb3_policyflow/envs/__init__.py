"""Environments of the paper, registered with Gymnasium when the package is imported."""

import importlib

import gymnasium as gym
from gymnasium.error import DependencyNotInstalled

_OWNERS = {"PointMaze": ("gymnasium_robotics", "robotics")}
"""Beginnings of other packages' environment ids: the module to import, and the extra with it."""


def register() -> None:
    """Register this package's environments with Gymnasium; calling it again changes nothing.

    Entry points are strings, so nothing is imported before an environment is made.
    """
    if "MultiGoal-v0" in gym.registry:
        return
    gym.register(
        "MultiGoal-v0",
        entry_point="sb3_policyflow.envs.multigoal:MultiGoalEnv",
        vector_entry_point="sb3_policyflow.envs.multigoal:MultiGoalVectorEnv",
        max_episode_steps=50,
    )
    gym.register(
        "PointMazeMultiGoal-Medium-v0",
        entry_point="sb3_policyflow.envs.point_maze:PointMazeMultiGoalEnv",
        max_episode_steps=600,
    )


def ensure_registered(env_id: str) -> None:
    """Import the package that registers an environment of the paper, if it is not registered yet.

    Call it before ``gymnasium.make`` where an id comes from a user. Ids that no known package
    registers are left to ``gymnasium.make``, whose error names the nearest ones.

    :param env_id: for instance ``PointMaze_Medium_Diverse_GDense-v3``
    :raises DependencyNotInstalled: if that package is missing
    """
    for prefix, (module, extra) in _OWNERS.items():
        if env_id.startswith(prefix) and env_id not in gym.registry:
            import_extra(module, extra, env_id)


def import_extra(module: str, extra: str, env_id: str) -> None:
    """Import a module that only an extra of this package brings.

    :raises DependencyNotInstalled: if it is missing, with the command that installs it
    """
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise DependencyNotInstalled(
            f"{env_id} needs {module}: pip install 'sb3-policyflow[{extra}]'"
        ) from error
