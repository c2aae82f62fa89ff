"""PolicyFlow for Stable-Baselines3: on-policy reinforcement learning with flow policies."""

from sb3_policyflow import _moved, envs
from sb3_policyflow.dppo import DPPO
from sb3_policyflow.fpo import FPO
from sb3_policyflow.integrations.rl_zoo3 import startup
from sb3_policyflow.policyflow import PolicyFlow

__version__ = "0.2.0.dev0"

__all__ = ["DPPO", "FPO", "PolicyFlow", "__version__"]

_moved.install()
envs.register()
# For interpreters that read no .pth files; others have done it at startup.
startup.install()
