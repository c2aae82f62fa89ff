"""IsaacLab's script and presets, on fakes of its versions 2 and 3."""

import argparse
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import torch as th
from fakes import EACH, FAKES, SMALL, TASKS, assert_refused

from sb3_policyflow import PolicyFlow
from sb3_policyflow.integrations.isaaclab import lab, presets
from sb3_policyflow.integrations.isaaclab.train import main, read_agent, run


def run_script(version: str | None, folder: Path, *arguments: str) -> str:
    """Run the script in a process of its own, and return what it printed."""
    paths = [FAKES.parents[3], FAKES / "common", *([FAKES / version] if version else [])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    command = [sys.executable, "-m", "sb3_policyflow.integrations.isaaclab", *arguments]
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# The script


@pytest.mark.slow
@EACH
def test_trains_and_goes_on(version: str, tmp_path: Path) -> None:
    task = TASKS[version]
    common = ("--task", task, "--num_envs", "16", "--max_iterations", "4", "--headless")
    said = run_script(version, tmp_path, *common, *SMALL, "--save_interval", "2", "--seed", "7")
    assert "ep_rew_mean" in said
    assert said.count("environment closed") == said.count("simulation closed") == 1
    (folder,) = (tmp_path / "logs" / "sb3_policyflow" / task).iterdir()
    names = {path.name for path in folder.iterdir()}
    assert {"model.zip", "model_256_steps.zip", "model_512_steps.zip", "PolicyFlow_1"} <= names
    model = PolicyFlow.load(folder / "model.zip")
    assert (model.seed, model.n_envs, model.num_timesteps) == (7, 16, 512)
    assert (model.batch_size, model.clip_range_vf(1.0), model.policy.n_flow_steps) == (32, 0.2, 2)
    assert model.policy.activation_fn is th.nn.ELU
    run_script(version, tmp_path, *common, "--checkpoint", f"{folder}/model", "--log_dir", "on")
    model = PolicyFlow.load(tmp_path / "on" / "model.zip")
    assert (model.seed, model.n_steps, model.num_timesteps) == (7, 8, 1024)


@pytest.mark.parametrize("version", [None])
@pytest.mark.usefixtures("installed")
def test_without_isaaclab(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--task", "Isaac-Ant-v0"]
    assert_refused(arguments, "IsaacLab is not installed in this Python", "isaaclab.sh -p -m")
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "--max_iterations" in capsys.readouterr().out


@pytest.mark.parametrize("version", [None])
@pytest.mark.parametrize(
    ("module", "sentence"),
    [
        ("omni/isaac/lab/__init__.py", "This is IsaacLab 1"),
        ("isaaclab/app.py", "is neither version 2 nor 3"),
    ],
)
@pytest.mark.usefixtures("installed")
def test_other_versions(module: str, sentence: str) -> None:
    Path(module).parent.mkdir(parents=True)
    Path(module).touch()
    assert_refused(["--task", "Isaac-Ant-v0"], sentence)


@pytest.mark.parametrize("version", [None])
@pytest.mark.usefixtures("installed")
def test_an_isaaclab_that_lacks_something_shows_what() -> None:
    Path("isaaclab").mkdir()
    Path("isaaclab", "app.py").write_text("import isaacsim")
    with pytest.raises(ModuleNotFoundError, match="No module named 'isaacsim'"):
        main(["--task", "Isaac-Ant-v0"])


@pytest.mark.parametrize(
    ("version", "arguments", "parts"),
    [
        ("two", ["--task", "Isaac-Velocity-Flat-Anymal-E-v0"], ["There is no task", "Anymal-D-v0"]),
        ("two", ["--task", "Isaac-Velocity-Flat-AnymalD"], ["did you mean", TASKS["two"]]),
        ("three", ["--task", "Isaac-Lift-Cube-Franka-v0"], ["IsaacContrib-Lift-Cube-Franka"]),
        ("three", ["--task", "Isaac-Ant"], ["no hyperparameters for Isaac-Ant", TASKS["three"]]),
        ("two", ["--task", TASKS["two"], "--agent", "sb3"], ["'sb3', but rsl_rl_cfg_entry_point"]),
        (
            "two",
            ["--task", TASKS["two"], "agent.timeout_bootstrap=terminal"],
            ["does not return the last observation", "agent.timeout_bootstrap=current"],
        ),
    ],
)
@pytest.mark.usefixtures("installed")
def test_what_is_refused(arguments: list[str], parts: list[str]) -> None:
    assert_refused([*arguments, *SMALL], *parts)


@pytest.mark.slow
def test_importing_needs_no_isaaclab() -> None:
    module = "sb3_policyflow.integrations.isaaclab.train"
    code = f"import sys, {module}; sys.exit('isaaclab' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


# Presets


def test_presets_are_the_papers() -> None:
    """One column of each of the paper's tables, and that all have what they share."""
    g1 = presets.rough_g1()
    assert (g1["ent_coef"], g1["brownian_coef"], g1["learning_rate"]) == (0.002, 0.006, 1e-3)
    assert g1["policy_kwargs"]["embedding_dim"] == 256
    drawer = presets.open_drawer_franka()
    assert (drawer["ent_coef"], drawer["brownian_coef"]) == (0.0008, 0.0002)
    assert (drawer["n_steps"], drawer["policy_kwargs"]["net_arch"]) == (96, [256, 128, 64])
    assert presets.lift_cube_franka()["gamma"] == 0.98
    assert len(presets.TASKS) == 8
    for name in presets.TASKS:
        agent = getattr(presets, name)()
        assert (agent["desired_kl"], agent["vf_coef"], agent["n_minibatches"]) == (0.01, 1.0, 4)
        assert json.loads(json.dumps(agent)) == agent, "plain values, as Hydra wants them"
        agent["policy_kwargs"]["net_arch"].append(1)
        assert getattr(presets, name)()["policy_kwargs"]["net_arch"][-1] != 1


@pytest.mark.parametrize("version", ["two"])
@pytest.mark.parametrize("name", presets.TASKS)
@pytest.mark.usefixtures("installed")
def test_every_preset_makes_a_model(name: str) -> None:
    fake = importlib.import_module("fake_lab")
    env = fake.Sb3Wrapper(fake.LabEnv(fake.EnvConfig()), -100.0, 100.0)
    agent = fake.process_sb3_cfg(getattr(presets, name)(), env.num_envs)
    assert agent.pop("n_timesteps") % (presets.PAPER_N_ENVS * agent["n_steps"]) == 0
    model = PolicyFlow(agent.pop("policy"), env, **agent)
    assert model.n_steps * 4 == 4 * model.batch_size


@EACH
@pytest.mark.usefixtures("installed")
def test_registered_presets_leave_others_alone(version: str) -> None:
    importlib.import_module("isaaclab_tasks")
    task = TASKS[version]
    gym.registry[task].kwargs[presets.AGENT_KEY] = "mine:agent"
    found = presets.register_presets()
    assert task in found
    assert gym.registry[task].kwargs[presets.AGENT_KEY] == "mine:agent"
    other = next(name for name in found if name != task)
    assert (
        gym.registry[other]
        .kwargs[presets.AGENT_KEY]
        .startswith("sb3_policyflow.integrations.isaaclab")
    )


@EACH
@pytest.mark.usefixtures("installed")
def test_numbers_of_timesteps() -> None:
    agent, n_timesteps, normalization = read_agent(presets.quadcopter(), 64, None, None)
    assert (n_timesteps, agent["batch_size"], agent["seed"]) == (200 * 24 * 4096, 384, 42)
    assert (agent["learning_rate"](0.3), normalization) == (5e-4, {})
    assert read_agent(presets.quadcopter(), 64, 3, 1)[1] == 3 * 24 * 64
    without = {key: value for key, value in presets.quadcopter().items() if key != "n_timesteps"}
    with pytest.raises(lab.LabError, match="have no n_timesteps: give --max_iterations"):
        read_agent(without, 64, None, None)


def test_several_processes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    started = {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}
    for name, value in started.items():
        monkeypatch.setenv(name, value)
    configured, options = lab.Configured({}, None), argparse.Namespace()
    with pytest.raises(lab.LabError, match="start it without torchrun"):
        run(configured, options)
