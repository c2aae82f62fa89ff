"""What registers environments, and what is said where packages are missing or broken."""

import subprocess
import sys

import pytest

import sb3_policyflow.envs


def run(code, **options):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_ids_are_known_without_the_simulator():
    done = run(
        "import sys, gymnasium as gym, sb3_policyflow\n"
        "from sb3_policyflow.envs.task_names import *\n"
        "for task in PLAYGROUND_TASKS + OTHER_PLAYGROUND_TASKS:\n"
        "    assert gym.spec(f'Playground/{task}-v0').vector_entry_point is not None\n"
        "import sb3_policyflow.envs.playground\n"
        "assert not {'jax', 'mujoco', 'mujoco_playground'} & set(sys.modules)"
    )
    assert done.returncode == 0, done.stderr
    assert len(sb3_policyflow.envs.PLAYGROUND_TASKS) == 10


@pytest.mark.parametrize(
    "make",
    [
        "gym.make('Playground/CheetahRun-v0')",
        "gym.make_vec('Playground/CheetahRun-v0', 4)",
        "gym.make('Playground/HopperHop-v0')",
        "ensure_registered('Playground/MyTask-v0')",
    ],
)
def test_a_missing_extra_is_named_in_one_sentence(make):
    done = run(
        "import sys; sys.modules['mujoco_playground'] = None\n"
        "import gymnasium as gym\n"
        "from sb3_policyflow.envs import ensure_registered\n" + make
    )
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("gymnasium.error.DependencyNotInstalled: Playground/")
    assert last.endswith("pip install 'sb3-policyflow[playground]'")


@pytest.mark.parametrize(
    "fault",
    [
        "import not_there",
        "import math; math.not_there",
        "raise ImportError('not_there\\nand how to\\nmend it')",
    ],
)
def test_a_broken_package_is_told_from_a_missing_one(fault, tmp_path):
    (tmp_path / "mujoco_playground.py").write_text(fault)
    done = run(
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import gymnasium as gym, sb3_policyflow\n"
        "gym.make('Playground/CheetahRun-v0')",
        cwd=tmp_path,
    )
    last = done.stderr.strip().splitlines()[-1]
    assert "which does not go with the packages installed here" in last
    assert "not_there" in last
    assert last.endswith("pip install 'sb3-policyflow[playground]' --upgrade")


def test_an_old_version_is_named_before_it_is_imported(tmp_path):
    (tmp_path / "mujoco_playground.py").write_text("import what_it_had_then")
    (tmp_path / "playground-0.0.5.dist-info").mkdir()
    metadata = "Metadata-Version: 2.1\nName: playground\nVersion: 0.0.5\n"
    (tmp_path / "playground-0.0.5.dist-info" / "METADATA").write_text(metadata)
    done = run(
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import gymnasium as gym, sb3_policyflow\n"
        "gym.make('Playground/CheetahRun-v0')",
        cwd=tmp_path,
    )
    last = done.stderr.strip().splitlines()[-1]
    assert "needs playground 0.2 or newer, and 0.0.5 is installed: pip install" in last
