"""The paper's MultiGoal figure."""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from sb3_policyflow.benchmark import multigoal
from sb3_policyflow.benchmark.results import Run, load_results
from sb3_policyflow.benchmark.train_one import train_one
from sb3_policyflow.benchmark.variants import variant_runs

FAST = {"n_envs": 8, "n_steps": 8, "batch_size": 64, "n_epochs": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of two variants, hardly trained."""
    path = tmp_path_factory.mktemp("multigoal")
    for name in ("d-uniform", "c-fpo"):
        variant = multigoal.VARIANTS[name]
        for seed in (0, 1):
            train_one(
                Run(
                    name,
                    variant.algo,
                    multigoal.ENV,
                    seed,
                    60,
                    {**variant.hyperparams, **FAST},
                    n_evaluations=1,
                    n_episodes=2,
                    n_trajectories=50,
                ),
                path,
            )
    return path


def test_panels_are_the_papers() -> None:
    parser = ArgumentParser()
    multigoal.add_arguments(parser)
    arguments = parser.parse_args(["--seeds", "0", "1", "2", "--steps", "1000"])
    runs = variant_runs(multigoal.VARIANTS, arguments, env=multigoal.ENV)
    assert len(runs) == 18
    assert {run.algo for run in runs} == {"ppo", "dppo", "fpo", "policyflow"}
    assert len({run.path(Path(), ".json") for run in runs}) == 18
    assert {run.steps for run in runs} == {1000}
    assert all(run.hyperparams.items() >= multigoal.ROLLOUTS.items() for run in runs)
    assert [variant.title[:3] for variant in multigoal.VARIANTS.values()] == [
        f"({letter})" for letter in "abcdef"
    ]


def test_figure_and_table(folder: Path) -> None:
    multigoal.draw(folder, load_results(folder))
    assert (folder / "multigoal.png").stat().st_size > 20_000
    table = (folder / "multigoal.md").read_text()
    assert "| (c) FPO | 2 |" in table
    assert "| (d) PolicyFlow, uniform noise | 2 |" in table
    assert "Environment steps: 64." in table  # one rollout, where 60 were asked for


def test_kept_trajectories(folder: Path) -> None:
    [result] = [r for r in load_results(folder) if (r.run.name, r.run.seed) == ("c-fpo", 1)]
    trajectories = multigoal.load_trajectories(result.run, folder)
    assert trajectories.positions.shape == (50, 51, 2)
    np.testing.assert_array_equal(trajectories.positions[:, 0], np.zeros((50, 2)))
    goals = result.summary["goals"]
    assert sum(goals["counts"]) + goals["n_missed"] == 50
    assert goals["mean_return"] == pytest.approx(float(trajectories.returns.mean()), rel=1e-4)


def test_hyperparameters_of_a_variant_reach_the_training(folder: Path) -> None:
    [result] = [r for r in load_results(folder) if (r.run.name, r.run.seed) == ("d-uniform", 0)]
    assert result.summary["hyperparams"]["uniform_noise_coef"] == "0.05"
    assert result.summary["hyperparams"]["brownian_coef"] == "0.0"
    # Those of the YAML file stay.
    assert result.summary["hyperparams"]["desired_kl"] == "0.01"
