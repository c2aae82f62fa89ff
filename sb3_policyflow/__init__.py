"""PolicyFlow for Stable-Baselines3: on-policy reinforcement learning with flow policies."""

from sb3_policyflow import envs as _envs
from sb3_policyflow.policyflow import PolicyFlow

__version__ = "0.1.0"

__all__ = ["PolicyFlow", "__version__"]

_envs.register()
