"""The IsaacLab script against fakes of versions 2 and 3: nothing here ever ran on IsaacLab itself.

The fakes are in ``fake_isaaclab``: the launchers, the registries and the wrapper, with the
oddities of the real ones.
"""

import importlib
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.integrations.isaaclab import lab, presets
from sb3_policyflow.integrations.isaaclab.checkpoint import read_checkpoint
from sb3_policyflow.integrations.isaaclab.train import main, make_parser, read_agent, train

FAKES = Path(__file__).parent / "fake_isaaclab"
TASKS = {"two": "Isaac-Velocity-Flat-Anymal-D-v0", "three": "Isaac-Velocity-Flat-AnymalD"}
EACH = pytest.mark.parametrize("version", TASKS)
THREE = pytest.mark.parametrize("version", ["three"])
SMALL = ["agent.n_steps=8", "agent.n_flow_steps=2", "--num_envs", "16"]


@pytest.fixture
def installed(
    version: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[None]:
    """Make one version importable in this process, for the length of a test."""
    registry = dict(gym.registry)
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, FAKES / "common", *([FAKES / version] if version else [])):
        monkeypatch.syspath_prepend(folder)
    yield
    gym.registry.clear()
    gym.registry.update(registry)
    forget_isaaclab()


def forget_isaaclab() -> None:
    """Let the next import find what is importable then."""
    for name in [name for name in sys.modules if name.startswith(("isaaclab", "fake_lab", "omni"))]:
        del sys.modules[name]


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


def assert_refused(arguments: list[str], *parts: str) -> None:
    """That the script ends with one line which has these parts."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


# The script


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
    assert (model.batch_size, model.clip_range_vf(1.0), model.n_flow_steps) == (32, 0.2, 2)
    assert model.policy.activation_fn is th.nn.ELU
    run_script(version, tmp_path, *common, "--checkpoint", f"{folder}/model", "--log_dir", "on")
    model = PolicyFlow.load(tmp_path / "on" / "model.zip")
    assert (model.seed, model.n_steps, model.num_timesteps) == (7, 8, 1024)


@EACH
@pytest.mark.usefixtures("installed")
def test_normalization_is_that_of_isaaclabs_files(version: str) -> None:
    common = ["--task", TASKS[version], "--num_envs", "16", "--max_iterations", "2"]
    common += ["--log_dir", "out"]
    main([*common, *SMALL, "agent.normalize_input=1", "agent.clip_obs=5"])
    statistics = Path("out", "model_vecnormalize.pkl")
    first: Any = pickle.loads(statistics.read_bytes())
    forget_isaaclab()
    main([*common, "--checkpoint", "out/model.zip"])
    second: Any = pickle.loads(statistics.read_bytes())
    assert (first.clip_obs, first.norm_reward) == (5, False)
    # Statistics count the first observations, and go on from those of the file.
    assert (first.obs_rms.count, second.obs_rms.count) == pytest.approx((17 * 16, 34 * 16))


@EACH
@pytest.mark.usefixtures("installed")
def test_lost_statistics_are_missed_before_the_simulator_starts(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model tells, even if the preset knows of no normalization."""
    common = ["--task", TASKS[version], "--num_envs", "16", "--max_iterations", "1"]
    main([*common, *SMALL, "agent.normalize_value=1", "--log_dir", "out"])
    statistics = Path("out", "model_vecnormalize.pkl")
    statistics.write_bytes(statistics.read_bytes()[:9])
    monkeypatch.setattr(lab, "check_task", lambda task, agent: pytest.fail("has started"))
    resumed = [*common, "--checkpoint", "out/model.zip"]
    assert_refused(resumed, f"{statistics} cannot be resumed: ")
    statistics.write_bytes(pickle.dumps({}))
    assert_refused(resumed, f"{statistics} does not hold statistics of VecNormalize")
    statistics.unlink()
    assert_refused(
        resumed, f"trained with VecNormalize, but its statistics are not at {statistics}"
    )


@THREE
@pytest.mark.usefixtures("installed")
def test_a_model_without_statistics_stays_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the preset says, and whatever an earlier run has left in the folder."""
    common = ["--task", TASKS["three"], "--num_envs", "16", "--max_iterations", "1"]
    main([*common, *SMALL, "agent.normalize_input=1", "--log_dir", "out"])
    forget_isaaclab()
    main([*common, *SMALL, "--log_dir", "out"])
    assert Path("out", "model_vecnormalize.pkl").is_file()
    preset = {**presets.flat_anymal_d(), "normalize_input": True}
    monkeypatch.setattr(presets, "flat_anymal_d", lambda: preset)
    forget_isaaclab()
    main([*common, "--checkpoint", "out/model.zip", "--log_dir", "on"])
    assert PolicyFlow.load("on/model.zip").num_timesteps == 2 * 8 * 16
    assert not Path("on", "model_vecnormalize.pkl").exists()


@THREE
@pytest.mark.usefixtures("installed")
def test_statistics_of_a_file_that_does_not_tell() -> None:
    env = VecNormalize(wrapped())
    PolicyFlow("MlpPolicy", env, n_steps=8, batch_size=8).save("model", exclude=["resume_state"])
    assert read_checkpoint(Path("model"), []).statistics is None
    env.save("model_vecnormalize.pkl")
    assert isinstance(read_checkpoint(Path("model"), []).statistics, VecNormalize)


@THREE
@pytest.mark.usefixtures("installed")
def test_what_a_model_brings_along(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the preset's: rollouts, what time limits are bootstrapped from, normalization."""
    made = []
    monkeypatch.setattr(
        "sb3_policyflow.integrations.isaaclab.train.wrap",
        lambda env, bounds: made.append(env.unwrapped.cfg) or lab.wrap(env, bounds),
    )
    common = ["--task", TASKS["three"], "--num_envs", "16", "--max_iterations", "2"]
    other = ["agent.timeout_bootstrap=terminal", "agent.normalize_value=1"]
    main([*common, *SMALL, *other, "--log_dir", "out"])
    forget_isaaclab()
    main([*common, "--checkpoint", "out/model.zip", "--seed", "9", "--log_dir", "on"])
    model = PolicyFlow.load("on/model.zip")
    assert (model.num_timesteps, model.timeout_bootstrap) == (2 * 2 * 8 * 16, "terminal")
    assert [(config.compute_final_obs, config.seed) for config in made] == [(True, 42), (True, 9)]
    assert model.seed == 9
    assert pickle.loads(Path("on", "model_vecnormalize.pkl").read_bytes()).norm_reward


@EACH
@pytest.mark.usefixtures("installed")
def test_what_cannot_be_gone_on_from_is_said_before_the_simulator_starts(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Both versions see whether the task is there when they start.
    monkeypatch.setattr(lab, "check_task", lambda task, agent: pytest.fail("has started"))
    common = ["--task", TASKS[version], "--num_envs", "16", "--max_iterations", "1", "--checkpoint"]
    assert_refused([*common, "no/model.zip"], "There is no model no/model.zip")
    Path("empty.zip").touch()
    assert_refused([*common, "empty.zip"], "empty.zip cannot be resumed: ")
    PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8).save("model.zip")
    with ZipFile("model.zip") as whole, ZipFile("other.zip", "w") as other:
        for name in whole.namelist():
            other.writestr(name, b"{}" if name.endswith(".pth") else whole.read(name))
    assert_refused([*common, "other.zip"], "other.zip cannot be resumed: ")
    FPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8).save("fpo.zip")
    assert_refused([*common, "fpo.zip"], "fpo.zip cannot be resumed: ", "not FPOPolicy")
    assert_refused([*common, "model", "agent=large"], "leave out agent=large, or --checkpoint")
    changes = ["agent.gamma=0.9", "env.x=1", "agent.n_timesteps=9"]
    assert_refused([*common, "model.zip", *changes], "leave out agent.gamma=0.9, or --checkpoint")
    with pytest.raises(pytest.fail.Exception, match="has started"):
        main([*common, "model.zip", *changes[1:]])


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
            ["--task", TASKS["two"], "--action_bounds", "-1", "1"],
            ["by -100 and 100, not by -1 and 1"],
        ),
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


# The wrapper's contract


def wrapped(n_envs: int = 4, final: bool = False, **options: Any) -> Any:
    """The fake environment in the wrapper of version 3, as the script wraps it."""
    tasks = importlib.import_module("isaaclab_tasks")
    config = tasks.EnvConfig()
    config.scene.num_envs = n_envs
    lab.prepare_timeouts(config, "terminal" if final else "current")
    env = gym.make(TASKS["three"], cfg=config)
    return lab.wrap(env, options.get("bounds", (-100.0, 100.0)))


@THREE
@pytest.mark.usefixtures("installed")
def test_bounds_of_actions() -> None:
    assert wrapped().action_space == spaces.Box(-100, 100, (2,))
    assert wrapped(bounds=(-1.0, 1.0)).action_space == spaces.Box(-1, 1, (2,))


@THREE
@pytest.mark.parametrize("final", [False, True])
@pytest.mark.usefixtures("installed")
def test_time_limits_are_bootstrapped_from_what_there_is(
    final: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the last observation where IsaacLab computes it, else from the one before it.

    Observations end with the episode's time, so a critic that returns it tells which one it saw.
    """
    env = wrapped(n_envs=64, final=final)
    limit = importlib.import_module("fake_lab").LIMIT
    bootstrap = "terminal" if final else "current"
    model = PolicyFlow(
        "MlpPolicy", env, n_steps=16, batch_size=256, seed=0, gamma=0.9, timeout_bootstrap=bootstrap
    )
    monkeypatch.setattr(model.policy, "predict_values", lambda observations: observations[:, -1:])
    seen: list[Any] = []

    def keep(variables: Any, _: Any) -> bool:
        seen.append((variables["rewards"].copy(), [dict(info) for info in variables["infos"]]))
        return True

    model.learn(16 * 64, keep)
    truncated = np.array([[bool(i.get("TimeLimit.truncated")) for i in infos] for _, infos in seen])
    bonus = model.rollout_buffer.rewards - np.stack([rewards for rewards, _ in seen])
    assert 50 < truncated.sum() < truncated.size / 4
    expected = 0.9 * (limit if final else limit - 1) * truncated
    np.testing.assert_allclose(bonus, expected, atol=1e-5)


@THREE
@pytest.mark.parametrize("algorithm", [PolicyFlow, FPO, DPPO])
@pytest.mark.usefixtures("installed")
def test_trains_in_4096_environments(algorithm: type[Any], tmp_path: Path) -> None:
    env = wrapped(n_envs=4096)
    options = {"timeout_bootstrap": "current", "seed": 0, "tensorboard_log": str(tmp_path)}
    kwargs = {"net_arch": [16], "embedding_dim": 8}
    model = algorithm(
        "MlpPolicy", env, n_steps=4, batch_size=4096, n_epochs=1, policy_kwargs=kwargs, **options
    ).learn(2 * 4 * 4096)
    assert len(model.ep_info_buffer) == 100
    assert np.isfinite([episode["r"] for episode in model.ep_info_buffer]).all()
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    mean, _ = evaluate_policy(loaded, env, n_eval_episodes=5, warn=False)
    assert np.isfinite(mean)


@THREE
@pytest.mark.usefixtures("installed")
def test_train_returns_a_model_that_can_go_on(tmp_path: Path) -> None:
    env = wrapped(n_envs=8)
    options = make_parser().parse_args(["--task", TASKS["three"], "--log_dir", str(tmp_path)])
    agent, _, _ = read_agent({**presets.flat_anymal_d(), "n_steps": 4}, 8, 1, 0)
    model = train(env, agent, 64, {"normalize_value": True}, options)
    assert isinstance(model.get_env(), VecNormalize)
    assert model.learn(32, reset_num_timesteps=False).num_timesteps == 96
