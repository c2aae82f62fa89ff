"""Tasks of MuJoCo Playground, vectorized by MuJoCo MJX on JAX (extra ``playground``).

JAX is imported when an environment is made.
"""

from sb3_policyflow.envs.playground.environments import (
    PlaygroundEnv,
    PlaygroundVecEnv,
    PlaygroundVectorEnv,
    TensorStep,
)

__all__ = ["PlaygroundEnv", "PlaygroundVecEnv", "PlaygroundVectorEnv", "TensorStep"]
