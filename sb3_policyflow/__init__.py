"""PolicyFlow for Stable-Baselines3: on-policy reinforcement learning with flow policies."""

__version__ = "0.1.0"

from sb3_policyflow import envs as _envs

_envs.register()
