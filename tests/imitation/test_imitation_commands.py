"""From commands to a better policy, with rl_zoo3."""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_policyflow import PolicyFlow
from sb3_policyflow.imitation import (
    Demonstrations,
    load_demonstrations,
    record_episodes,
    save_episodes,
)
from sb3_policyflow.imitation.__main__ import main as clone_command
from sb3_policyflow.imitation.demonstrate import main as demonstrate_command
from sb3_policyflow.imitation.record import main as record_command
from tests.imitation.short import shown


def test_demonstrate(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "shown.npz"
    demonstrate_command(
        ["--env", "MultiGoal-v0", "--style", "slow", "--episodes", "3", "--out", str(path)]
    )
    assert "Wrote 3 episodes with a mean return of" in capfd.readouterr().out
    assert load_demonstrations(path).actions.shape == (150, 2)


@pytest.mark.slow
def test_from_commands_to_a_better_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3")
    monkeypatch.chdir(tmp_path)
    algo = ["--algo", "policyflow", "--env", "Pendulum-v1"]
    small = ["-params", "n_steps:64", "n_envs:2", "batch_size:32", "normalize:True"]
    env = make_vec_env("Pendulum-v1", n_envs=2, seed=0)
    save_episodes(record_episodes(PPO("MlpPolicy", env, seed=0), n_episodes=2), "shown.npz", env)

    clone_command(
        [
            *algo,
            "--dataset",
            "shown.npz",
            "--gradient-steps",
            "20",
            "--out",
            "clones/model.zip",
            *small,
            "n_critic_warmup:1",
        ]
    )
    assert PolicyFlow.load("clones/model.zip").cloned_parameters is not None
    assert Path("clones/Pendulum-v1/vecnormalize.pkl").is_file()

    def train(*arguments: str) -> str:
        command = [sys.executable, "-m", "rl_zoo3.train", *algo, "-f", "logs", "-n", "128"]
        command += ["--eval-freq", "-1", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "Loading saved VecNormalize stats" in train("-i", "clones/model.zip", *small)
    # At once: cloned, then trained
    train(*small, "demonstrations:'shown.npz'", "imitation_kwargs:dict(gradient_steps=20)")
    record_command([*algo, "-f", "logs", "--episodes", "2", "--n-envs", "2", "--out", "own.npz"])
    assert "Wrote 2 episodes" in capfd.readouterr().out
    assert len(load_demonstrations("own.npz").actions) == 400


def test_a_dot_in_a_name_is_part_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rl_zoo3")
    monkeypatch.chdir(tmp_path)
    Demonstrations(*shown()).save("shown1.0")
    other = tmp_path / "clones" / "noise0.cloning"
    other.parent.mkdir()
    other.write_text("not theirs")
    command = ["--env", "Pendulum-v1", "--dataset", "shown1.0.npz", "--gradient-steps", "2"]
    for noise in ("0.3", "0.5"):
        kwargs = f"imitation_kwargs:dict(noise_std={noise})"
        clone_command([*command, "--out", f"clones/noise{noise}", "-params", kwargs])
    assert {path.name for path in Path("clones").glob("*.*")} == {
        "noise0.3.zip",
        "noise0.5.zip",
        "noise0.cloning",
    }
    stds = [
        PolicyFlow.load(path).policy.log_std.exp().item() for path in Path("clones").glob("*.zip")
    ]
    assert sorted(stds) == pytest.approx([0.3, 0.5])


def experiment(algo: str = "policyflow", **options: Any) -> Any:
    """An ``ExperimentManager`` of rl_zoo3 for the pendulum."""
    manager = pytest.importorskip("rl_zoo3.exp_manager").ExperimentManager
    return manager(argparse.Namespace(), algo, "Pendulum-v1", "logs", **options)


@pytest.mark.parametrize(
    ("hyperparams", "options", "what"),
    [
        ({"imitation_kwargs": {"seed": 1}}, {}, "imitation_kwargs needs demonstrations"),
        (
            {"demonstrations": "a.npz", "imitation_kwargs": "seed"},
            {},
            "imitation_kwargs must be a dictionary",
        ),
        (
            {"demonstrations": "a.npz"},
            {"optimize_hyperparameters": True, "n_evaluations": 1},
            "Trials of --optimize do not clone",
        ),
        ({"demonstrations": "a.npz"}, {}, "no demonstrations at a.npz"),
        (
            {"demonstrations": "a.npz", "imitation_kwargs": {"steps": 1}},
            {},
            "clone has no argument 'steps'",
        ),
        ({"demonstrations": "a.npz"}, {"algo": "sac"}, "SAC cannot be cloned"),
    ],
)
def test_what_rl_zoo3_cannot_do(
    hyperparams: dict[str, Any],
    options: dict[str, Any],
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=what):
        experiment(hyperparams=hyperparams, **options).setup_experiment()
