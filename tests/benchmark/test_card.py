"""A model card has the returns that were measured, in the form that Hugging Face reads."""

from pathlib import Path

import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

pytest.importorskip("rl_zoo3")

from sb3_policyflow import PolicyFlow
from sb3_policyflow.benchmark.__main__ import main
from sb3_policyflow.benchmark.card import write_card
from sb3_policyflow.benchmark.measure.evaluation import evaluate
from tests.helpers import SMALL, TINY


def test_the_card_has_the_measured_returns(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, **SMALL).learn(16)
    model.save(tmp_path / "model.zip")
    command = [str(tmp_path / "model.zip"), "--env", "Pendulum-v1", "--episodes", "2"]
    assert main(["card", *command, "--out", str(tmp_path / "card")]) == 0
    text = (tmp_path / "card" / "README.md").read_text()
    data = next(yaml.safe_load_all(text.split("\n---\n")[0]))
    [result] = data["model-index"][0]["results"]
    expected = evaluate(model, make_vec_env("Pendulum-v1", 1), "stochastic", 2)
    mean = float(result["metrics"][0]["value"].split()[0])
    assert mean == pytest.approx(expected["mean_return"], abs=0.01)
    assert result["dataset"]["name"] == "Pendulum-v1"
    assert PolicyFlow.load(tmp_path / "card" / "model.zip").num_timesteps == 16
    for mode in ("stochastic", "latent-only", "deterministic"):
        assert f"| {mode} (" in text


def test_the_statistics_belong_to_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 1))
    PolicyFlow("MlpPolicy", env, policy_kwargs=TINY, **SMALL).learn(16).save(tmp_path / "m.zip")
    env.save(str(tmp_path / "stats.pkl"))
    command = ["card", str(tmp_path / "m.zip"), "--env", "Pendulum-v1"]
    assert main(command) == 2
    assert "give them as statistics (--vecnormalize FILE)." in capsys.readouterr().err
    write_card(tmp_path / "m.zip", "Pendulum-v1", tmp_path / "card", tmp_path / "stats.pkl", 1)
    assert (tmp_path / "card" / "stats.pkl").is_file()
    assert main(["card", "nope.zip", "--env", "Pendulum-v1"]) == 2


def test_what_a_card_cannot_be_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, **SMALL).save(tmp_path / "plain")
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    PolicyFlow("MlpPolicy", env, policy_kwargs=TINY, **SMALL).save(tmp_path / "normalized")
    PPO("MlpPolicy", "Pendulum-v1").save(tmp_path / "ppo")
    env.save(str(tmp_path / "stats.pkl"))
    VecNormalize(make_vec_env("MultiGoal-v0")).save(str(tmp_path / "other.pkl"))
    (tmp_path / "text.pkl").write_text("text")
    for model, statistics, what in (
        ("plain", "stats.pkl", "leave out statistics (--vecnormalize)"),
        ("normalized", "other.pkl", "is of another environment than Pendulum-v1 ("),
        ("normalized", "text.pkl", "text.pkl cannot be read as statistics of VecNormalize"),
        ("ppo", "stats.pkl", "which is no flow policy"),
    ):
        command = [str(tmp_path / model), "--vecnormalize", str(tmp_path / statistics)]
        assert main(["card", *command, "--env", "Pendulum-v1", "--out", str(tmp_path / "c")]) == 2
        assert what in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_the_model_may_be_named_without_its_ending(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, **SMALL)
    model.save(tmp_path / "model_0.5.zip")
    command = ["--env", "Pendulum-v1", "--episodes", "1", "--out", str(tmp_path / "card")]
    assert main(["card", str(tmp_path / "model_0.5"), *command]) == 0
    assert (tmp_path / "card" / "model_0.5.zip").is_file()
    assert main(["card", str(tmp_path / "model_0.7"), *command]) == 2
    assert "model_0.7.zip" in capsys.readouterr().err
