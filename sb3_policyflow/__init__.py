"""PolicyFlow for Stable-Baselines3: on-policy reinforcement learning with flow policies."""

from sb3_policyflow import envs
from sb3_policyflow.dppo import DPPO
from sb3_policyflow.fpo import FPO
from sb3_policyflow.policyflow import PolicyFlow
from sb3_policyflow.startup import sb3_policyflow_startup

__version__ = "0.1.0"

__all__ = ["DPPO", "FPO", "PolicyFlow", "__version__"]

envs.register()
# For interpreters that read no .pth files; others have done it at startup.
sb3_policyflow_startup.install()
