"""The results in ``docs/results`` are those of the figures' commands as they are now."""

from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("gymnasium_robotics")

from sb3_policyflow.benchmark import multigoal, playground, pointmaze
from sb3_policyflow.benchmark.report.table import report, results_table
from sb3_policyflow.benchmark.results import load_results
from sb3_policyflow.benchmark.variants import Variants, variant_runs
from sb3_policyflow.envs.point_maze import ENV_ID

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def n_done(folder: str, variants: Variants, n_evaluations: int, steps: int, **fields: Any) -> int:
    """How many trainings of three seeds have been run; other settings are an error."""
    arguments = Namespace(variants=variants, seeds=[0, 1, 2], steps=steps)
    arguments.evaluations, arguments.episodes = n_evaluations, 2 * n_evaluations
    runs = variant_runs(variants, arguments, **fields)
    return sum(run.is_done(RESULTS / folder) for run in runs)


@pytest.mark.parametrize("name", ["classic", "mujoco", "pendulum", "halfcheetah"])
def test_tables_are_those_of_the_results(name: str) -> None:
    text = report(load_results(RESULTS / name))
    assert text == (RESULTS / name / "table.md").read_text(encoding="utf-8")
    page = (RESULTS.parent / "results.md").read_text(encoding="utf-8")
    assert results_table(load_results(RESULTS / name)) in page


def test_multigoal() -> None:
    fields = {"env": multigoal.ENV, "n_trajectories": multigoal.N_TRAJECTORIES}
    assert n_done("multigoal", multigoal.VARIANTS, 10, 3_000_000, **fields) == 18


def test_pointmaze() -> None:
    fields = {"env": ENV_ID, "keep_visits": True}
    assert n_done("pointmaze", pointmaze.VARIANTS, 10, 2_000_000, **fields) == 9


@pytest.mark.parametrize("task", playground.TASKS)
def test_playground(task: str) -> None:
    env = f"Playground/{task}-v0"
    assert n_done("playground", playground.VARIANTS, 5, 3_000_000, env=env) == 15


def test_playground_without_the_brownian_term() -> None:
    """The command that docs/results.md has for it."""
    variant = playground.VARIANTS["policyflow"]
    hyperparams = variant.hyperparams | {"brownian_coef": 0.0}
    text = (RESULTS.parent / "results.md").read_text(encoding="utf-8")
    assert f"\"policy_kwargs:'{hyperparams['policy_kwargs']}'\"" in text
    variants = {"policyflow": variant._replace(hyperparams=hyperparams)}
    env = "Playground/WalkerWalk-v0"
    assert n_done("playground-no-brownian", variants, 5, 3_000_000, env=env) == 3


@pytest.mark.parametrize("task", ["ReacherEasy", "FingerTurnEasy", "BallInCup", "WalkerWalk"])
def test_playground_held_out(task: str) -> None:
    names = ("policyflow", "policyflow-latent0.3", "ppo")
    variants = {name: playground.VARIANTS[name] for name in names}
    env = f"Playground/{task}-v0"
    assert n_done("playground-held-out", variants, 5, 3_000_000, env=env) == 9
