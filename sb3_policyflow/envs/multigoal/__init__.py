"""``MultiGoal-v0``, the paper's example: six goals that are equally good."""

from sb3_policyflow.envs.multigoal.environments import (
    MultiGoalEnv,
    MultiGoalState,
    MultiGoalVecEnv,
    MultiGoalVectorEnv,
)

__all__ = ["MultiGoalEnv", "MultiGoalState", "MultiGoalVecEnv", "MultiGoalVectorEnv"]
