"""What the tests of IsaacLab's script share: its fakes, and what is run on them.

The fakes are in ``fake_isaaclab``: the launchers, the registries and the wrapper, with the
oddities of the real ones. Nothing here ever ran on IsaacLab itself.
"""

import importlib
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sb3_policyflow.integrations.isaaclab import lab
from sb3_policyflow.integrations.isaaclab.train import main

FAKES = Path(__file__).parent / "fake_isaaclab"
TASKS = {"two": "Isaac-Velocity-Flat-Anymal-D-v0", "three": "Isaac-Velocity-Flat-AnymalD"}
EACH = pytest.mark.parametrize("version", TASKS)
THREE = pytest.mark.parametrize("version", ["three"])
SMALL = ["agent.n_steps=8", "agent.n_flow_steps=2", "--num_envs", "16"]


def forget_isaaclab() -> None:
    """Let the next import find what is importable then."""
    for name in [name for name in sys.modules if name.startswith(("isaaclab", "fake_lab", "omni"))]:
        del sys.modules[name]


def assert_refused(arguments: list[str], *parts: str) -> None:
    """That the script ends with one line which has these parts."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


def wrapped(n_envs: int = 4, final: bool = False, **options: Any) -> Any:
    """The fake environment in the wrapper of version 3."""
    bounds = options.get("bounds", (-100.0, 100.0))
    return lab.wrap_for_arrays(make_env(n_envs, final), bounds)


def make_env(n_envs: int = 4, final: bool = False, version: str = "three") -> Any:
    """The fake environment."""
    importlib.import_module("isaaclab_tasks")
    fakes = importlib.import_module("isaaclab_tasks" if version == "three" else "fake_lab")
    config = fakes.EnvConfig()
    config.scene.num_envs = n_envs
    lab.prepare_timeouts(config, "terminal" if final else "current")
    return gym.make(TASKS[version], cfg=config)
