"""Resuming from a model with IsaacLab's script, on fakes of its versions 2 and 3."""

import pickle
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from fakes import EACH, SMALL, TASKS, THREE, assert_refused, forget_isaaclab, wrapped
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import FPO, PolicyFlow
from sb3_policyflow.integrations.isaaclab import lab, presets
from sb3_policyflow.integrations.isaaclab.checkpoint import read_checkpoint
from sb3_policyflow.integrations.isaaclab.train import main


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
def test_lost_statistics_are_reported_before_the_simulator_starts(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model tells, even if the preset knows of no normalization."""
    common = ["--task", TASKS[version], "--num_envs", "16", "--max_iterations", "1"]
    main([*common, *SMALL, "agent.normalize_value=1", "--log_dir", "out"])
    statistics = Path("out", "model_vecnormalize.pkl")
    statistics.write_bytes(statistics.read_bytes()[:9])
    monkeypatch.setattr(lab, "check_task", lambda task, agent: pytest.fail("has started"))
    resumed = [*common, "--checkpoint", "out/model.zip"]
    assert_refused(resumed, f"{statistics} cannot be read as statistics of VecNormalize")
    statistics.write_bytes(pickle.dumps({}))
    assert_refused(resumed, f"{statistics} holds a dict, no VecNormalize")
    statistics.unlink()
    assert_refused(
        resumed, f"trained with VecNormalize, but its statistics are not at {statistics}"
    )


@THREE
@pytest.mark.usefixtures("installed")
def test_a_model_without_statistics_is_resumed_without(monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_without_a_state_the_file_of_statistics_decides() -> None:
    env = VecNormalize(wrapped())
    PolicyFlow("MlpPolicy", env, n_steps=8, batch_size=8).save("model", exclude=["resume_state"])
    assert read_checkpoint(Path("model"), []).statistics is None
    env.save("model_vecnormalize.pkl")
    assert isinstance(read_checkpoint(Path("model"), []).statistics, VecNormalize)


@THREE
@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("saved", ["model_0.5", "model_0.5.zip"])
def test_a_dot_in_a_name_is_part_of_it(saved: str) -> None:
    env = VecNormalize(wrapped())
    PolicyFlow("MlpPolicy", env, n_steps=8, batch_size=8).save(saved)
    env.save("model_0.5_vecnormalize.pkl")
    checkpoint = read_checkpoint(Path("model_0.5"), [])
    assert checkpoint.path == Path(saved)
    assert isinstance(checkpoint.statistics, VecNormalize)


@THREE
@pytest.mark.usefixtures("installed")
def test_a_model_brings_its_own_settings(monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_what_cannot_be_resumed_is_refused_before_the_simulator_starts(
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
    assert_refused(
        [*common, "fpo.zip"], "fpo.zip cannot be resumed: ", "saved by FPO, not by PolicyFlow"
    )
    assert_refused([*common, "model", "agent=large"], "leave out agent=large, or --checkpoint")
    changes = ["agent.gamma=0.9", "env.x=1", "agent.n_timesteps=9"]
    assert_refused([*common, "model.zip", *changes], "leave out agent.gamma=0.9, or --checkpoint")
    with pytest.raises(pytest.fail.Exception, match="has started"):
        main([*common, "model.zip", *changes[1:]])
