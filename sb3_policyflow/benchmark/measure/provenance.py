"""What a figure was measured with: versions, commit and machine."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch as th

import sb3_policyflow

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


def machine() -> dict[str, Any]:
    """The machine, and the versions."""
    return {
        "processor": _processor(),
        "avx512": " avx512f " in _cpuinfo(),
        "cores": os.cpu_count(),
        "torch_threads": th.get_num_threads(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "system": platform.platform(),
        **versions(),
    }


def _cpuinfo() -> str:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _processor() -> str:
    lines = _cpuinfo().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
