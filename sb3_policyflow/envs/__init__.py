"""Environments of the paper, registered with Gymnasium when the package is imported."""

import gymnasium as gym


def register() -> None:
    """Register this package's environments with Gymnasium; calling it again changes nothing.

    Entry points are strings, so nothing is imported before an environment is made.
    """
    if "MultiGoal-v0" not in gym.registry:
        gym.register(
            "MultiGoal-v0",
            entry_point="sb3_policyflow.envs.multigoal:MultiGoalEnv",
            vector_entry_point="sb3_policyflow.envs.multigoal:MultiGoalVectorEnv",
            max_episode_steps=50,
        )
