"""``MultiGoal-v0``, the paper's example: six goals that are equally good."""

from sb3_policyflow.envs.multigoal.environments import (
    MultiGoalEnv,
    MultiGoalState,
    MultiGoalVecEnv,
    MultiGoalVectorEnv,
)
from sb3_policyflow.envs.multigoal.tensors import MultiGoalTensorEnv

__all__ = [
    "MultiGoalEnv",
    "MultiGoalState",
    "MultiGoalTensorEnv",
    "MultiGoalVecEnv",
    "MultiGoalVectorEnv",
]
