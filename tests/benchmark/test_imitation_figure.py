"""The benchmark of cloned policies."""

from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from sb3_policyflow.benchmark import imitation
from sb3_policyflow.benchmark.results import load_results
from sb3_policyflow.benchmark.train_one import train_one

FAST = {"n_envs": 8, "n_steps": 8, "batch_size": 64, "n_epochs": 1}
CLONING = {"gradient_steps": 20, "batch_size": 64, "eval_freq": 10}


@pytest.mark.slow
def test_every_algorithm_is_cloned_trained_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parser = ArgumentParser()
    imitation.add_arguments(parser)
    arguments = parser.parse_args(["--out", str(tmp_path), "--styles", "slow", "--seeds", "3"])
    wanted = imitation.runs(arguments)
    assert [run.name for run in wanted] == [f"slow-{algo}" for algo in imitation.ALGORITHMS]
    assert {run.steps for run in wanted} == {5_000_000}
    imitation.make_demonstrations("slow", tmp_path, n_episodes=8)
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
    assert (tmp_path / "imitation.png").stat().st_size > 20_000
    table = (tmp_path / "imitation.md").read_text()
    assert "| slow | ppo | 1 | 64 |" in table  # one rollout, where 60 were asked for
