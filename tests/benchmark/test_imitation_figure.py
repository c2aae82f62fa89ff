"""The benchmark of cloned policies."""

import subprocess
import sys
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from sb3_policyflow.benchmark import imitation
from sb3_policyflow.benchmark.results import load_results
from sb3_policyflow.benchmark.train_one import train_one

ALGORITHMS = ("policyflow", "fpo", "dppo", "dppo_last", "ppo")
FAST = {"n_envs": 8, "n_steps": 8, "batch_size": 64, "n_epochs": 1}
CLONING = {"gradient_steps": 20, "batch_size": 64, "eval_freq": 10}


@pytest.mark.slow
def test_every_algorithm_is_cloned_trained_and_reported(tmp_path: Path) -> None:
    parser = ArgumentParser()
    imitation.add_arguments(parser)
    arguments = parser.parse_args(["--out", str(tmp_path), "--styles", "slow", "--seeds", "3"])
    wanted = imitation.runs(arguments)
    assert [run.name for run in wanted] == [f"slow-{algo}" for algo in ALGORITHMS]
    assert {run.steps for run in wanted} == {5_000_000}
    imitation.make_demonstrations(imitation.MULTI_GOAL, "slow", tmp_path, n_episodes=8)
    for run in wanted:
        small = {**run.hyperparams, **FAST, "imitation_kwargs": CLONING}
        train_one(
            replace(run, steps=60, hyperparams=small, n_evaluations=1, n_episodes=2,
                    n_trajectories=50),
            tmp_path,
        )  # fmt: skip
    results = load_results(tmp_path)
    for result in results:
        cloned = imitation.load_trajectories(result.run, tmp_path, "-cloned.npz")
        assert np.isfinite(cloned.returns).all()
        assert result.summary["cloned"]["goals"]["mean_return"] == pytest.approx(
            float(cloned.returns.mean()), rel=1e-4
        )
    imitation.draw(tmp_path, results)
    assert (tmp_path / "multigoal.png").stat().st_size > 20_000
    table = (tmp_path / "multigoal.md").read_text()
    assert "| slow | ppo | 1 | 64 |" in table  # one rollout, where 60 were asked for


def command(*options: str) -> subprocess.CompletedProcess[str]:
    """Run the command."""
    arguments = [sys.executable, "-m", "sb3_policyflow.benchmark", "imitation", *options]
    return subprocess.run(arguments, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_goals_of_the_maze_are_counted(tmp_path: Path) -> None:
    """Before and after the training."""
    pytest.importorskip("gymnasium_robotics")
    imitation.make_demonstrations(imitation.POINT_MAZE, "good", tmp_path, n_episodes=8)
    options = ["--task", "pointmaze", "--algos", "ppo", "--out", str(tmp_path)]
    parser = ArgumentParser()
    imitation.add_arguments(parser)
    (run,) = imitation.runs(parser.parse_args(options))
    small = {**run.hyperparams, "imitation_kwargs": CLONING}
    result = train_one(
        replace(
            run, steps=2048, hyperparams=small, n_evaluations=1, n_episodes=2, n_trajectories=3
        ),
        tmp_path,
    )
    for goals in (result.summary["cloned"]["goals"], result.summary["goals"]):
        assert sum(goals["counts"]) + goals["n_missed"] == 3
        assert len(goals["counts"]) == 4
    imitation.draw(tmp_path, load_results(tmp_path))
    table = (tmp_path / "pointmaze.md").read_text()
    missed = 100 * result.summary["goals"]["n_missed"] / 3
    assert "| good | ppo | 1 | 2,048 |" in table
    assert table.splitlines()[2].endswith(f"| {missed:.1f} |")


def test_what_a_task_does_not_have_is_refused() -> None:
    outcome = command("--task", "pointmaze", "--styles", "slow")
    assert outcome.returncode != 0
    assert "--styles slow: the task pointmaze has good." in outcome.stderr
