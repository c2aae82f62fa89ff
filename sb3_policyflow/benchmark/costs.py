"""What a training costs: gradient steps, network evaluations, versions and time."""

import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import sb3_policyflow
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.dppo import DPPO
from sb3_policyflow.fpo import FPO
from sb3_policyflow.policyflow import PolicyFlow

PACKAGES = (
    "gymnasium",
    "jax",
    "mujoco",
    "mujoco-mjx",
    "numba",
    "numpy",
    "playground",
    "rl_zoo3",
    "stable-baselines3",
    "torch",
)


class GradientSteps:
    """Counts the steps of a model's optimizer."""

    def __init__(self, model: OnPolicyAlgorithm) -> None:
        self.count = 0
        model.policy.optimizer.register_step_post_hook(self._count)

    def _count(self, *_: Any) -> None:
        self.count += 1


def evaluations_per_action(model: BaseAlgorithm) -> int:
    """Evaluations of the actor's network that one action takes."""
    policy = model.policy
    if isinstance(policy, FlowPolicy):
        return policy.n_evaluations_per_action
    return 1


def evaluations_per_sample(model: BaseAlgorithm) -> int:
    """Evaluations of the actor's network with which one sample enters one gradient step.

    PolicyFlow's old velocity counts, which each epoch looks up anew; FPO's old losses, of which
    there is one for all epochs, do not; neither does what an entropy bonus takes.
    """
    if isinstance(model, (PolicyFlow, FPO, DPPO)):
        return model.n_evaluations_per_sample
    return 1


def network_evaluations(model: OnPolicyAlgorithm, gradient_steps: int) -> dict[str, int]:
    """Evaluations of the actor's network for acting and for updating, over a training.

    Those for updating are of full minibatches: the last of an epoch may have been smaller.
    """
    algorithm: Any = model  # those that are compared all have a batch size
    return {
        "acting": model.num_timesteps * evaluations_per_action(model),
        "updating": gradient_steps * algorithm.batch_size * evaluations_per_sample(model),
    }


def commit() -> str | None:
    """The commit of a checkout, with a "+" if files differ from it; None if it is none."""

    def git(*arguments: str) -> str:
        folder = Path(sb3_policyflow.__file__).parent
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def versions() -> dict[str, str | None]:
    """Versions of what a training depends on; None for what is not installed."""
    return {
        "python": platform.python_version(),
        "sb3_policyflow": sb3_policyflow.__version__,
        "commit": commit(),
        **{package: _version(package) for package in PACKAGES},
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
