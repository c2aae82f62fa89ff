"""What registers environments, and the errors where packages are missing or broken."""

import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.error import DependencyNotInstalled

import sb3_policyflow.envs
from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs import ensure_registered
from sb3_policyflow.hints import install_command
from tests.helpers import SMALL

TASK = "Playground/CheetahRun-v0"


def test_registering_twice_is_silent() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3_policyflow.envs.register()


@pytest.mark.slow
def test_registering_imports_neither_torch_nor_mujoco() -> None:
    code = """
import importlib.util, sys, gymnasium
# The package without what it imports itself.
spec = importlib.util.find_spec("sb3_policyflow")
sys.modules["sb3_policyflow"] = importlib.util.module_from_spec(spec)
import sb3_policyflow.envs as envs
envs.register()
assert "MultiGoal-v0" in gymnasium.registry
assert not {"torch", "mujoco", "matplotlib"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_tasks_are_registered_without_the_simulator() -> None:
    code = """
import sys, gymnasium as gym, sb3_policyflow
from sb3_policyflow.envs.task_names import *
for task in PLAYGROUND_TASKS + OTHER_PLAYGROUND_TASKS:
    assert gym.spec(f"Playground/{task}-v0").vector_entry_point is not None
import sb3_policyflow.envs.playground
assert not {"jax", "mujoco", "mujoco_playground"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_paper_has_ten_tasks() -> None:
    assert len(sb3_policyflow.envs.PLAYGROUND_TASKS) == 10


def make_four(env_id: str) -> Any:
    return gym.make_vec(env_id, 4)


@pytest.mark.parametrize(
    ("make", "env_id", "module", "extra"),
    [
        (gym.make, TASK, "mujoco_playground", "playground"),
        (make_four, TASK, "mujoco_playground", "playground"),
        (gym.make, "Playground/HopperHop-v0", "mujoco_playground", "playground"),
        (ensure_registered, "Playground/MyTask-v0", "mujoco_playground", "playground"),
        (gym.make, "PointMazeMultiGoal-Medium-v0", "gymnasium_robotics", "robotics"),
        (ensure_registered, "PointMaze_Open-v9", "gymnasium_robotics", "robotics"),
    ],
)
def test_a_missing_extra_is_named_in_one_sentence(
    make: Callable[[str], Any],
    env_id: str,
    module: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    sentence = re.escape(f"{env_id} needs {module}: run `{install_command(extra)}`")
    with pytest.raises(DependencyNotInstalled, match=f"^{sentence}$"):
        make(env_id)


@pytest.mark.filterwarnings("ignore:.*Overriding environment")
def test_algorithms_find_the_environments_of_gymnasium_robotics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env_id = "PointMaze_UMaze-v3"
    monkeypatch.delitem(gym.registry, env_id, raising=False)
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(DependencyNotInstalled, match=f"{env_id} needs gymnasium_robotics: run"):
        PolicyFlow("MultiInputPolicy", env_id)
    monkeypatch.delitem(sys.modules, "gymnasium_robotics")  # as where nothing has imported it
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.delitem(gym.registry, env_id, raising=False)
    monkeypatch.delitem(sys.modules, "gymnasium_robotics")
    assert PolicyFlow("MultiInputPolicy", env_id, **SMALL).n_envs == 1


@pytest.fixture
def broken_playground(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module in place of MuJoCo Playground's, whose source is to be written."""
    monkeypatch.delitem(sys.modules, "mujoco_playground", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "mujoco_playground.py"


@pytest.mark.parametrize(
    "fault",
    [
        "import not_there",
        "import math; math.not_there",
        "raise ImportError('not_there\\nand how to\\nmend it')",
    ],
)
def test_a_broken_package_is_told_from_a_missing_one(fault: str, broken_playground: Path) -> None:
    broken_playground.write_text(fault)
    with pytest.raises(DependencyNotInstalled) as caught:
        gym.make(TASK)
    message = str(caught.value)
    assert "which does not work with the packages installed here" in message
    assert "not_there" in message
    assert message.endswith(f"`{install_command('playground', upgrade=True)}`")
    assert "\n" not in message


def test_an_old_version_is_named_before_it_is_imported(broken_playground: Path) -> None:
    broken_playground.write_text("import what_it_had_then")
    metadata = broken_playground.parent / "playground-0.0.5.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: playground\nVersion: 0.0.5\n")
    with pytest.raises(DependencyNotInstalled, match=r"playground 0\.2 or newer, and 0\.0\.5 is"):
        gym.make(TASK)
