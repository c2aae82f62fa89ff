"""The benchmark of a mediocre agent's demonstrations."""

from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")

from sb3_policyflow.benchmark import agent
from sb3_policyflow.benchmark.__main__ import main
from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.benchmark.results import Result, Run, load_results
from sb3_policyflow.benchmark.train_one import train_one

CLONING = {"gradient_steps": 20, "batch_size": 64, "eval_freq": 10}


def result(name: str, seed: int, returns: list[float]) -> Result:
    """A training whose evaluations, every 100 timesteps, had these returns."""
    run = Run(name, "policyflow", agent.ENV, seed, 100 * len(returns))
    curve = [
        {"timesteps": 100 * (index + 1), "mode": mode, "mean_return": value}
        for index, value in enumerate(returns)
        for mode, value in (("stochastic", value), ("deterministic", 10 * value))
    ]
    return Result(run, {"timesteps": run.steps}, curve)


def test_steps_to_a_return_are_those_of_the_first_evaluation_that_has_it() -> None:
    assert agent.steps_to(result("cloned", 0, [1.0, 5.0, 4.0, 6.0]), 5.0) == 200
    assert agent.steps_to(result("cloned", 0, [1.0, 2.0]), 5.0) is None


def test_table_says_how_many_seeds_have_reached_it() -> None:
    table = agent.agent_table(
        [
            result("cloned", 0, [4.0, 6.0]),
            result("cloned", 1, [1.0, 2.0]),
            result("scratch", 0, [0.0, 1.0]),
        ],
        5.0,
    )
    assert "steps to a return of 5 |" in table
    assert "| cloned | 2 | 200 | 2 (1 to 4) | 4 (2 to 6) | 200 (1 of 2 seeds) |" in table
    assert "| scratch | 1 | 200 | 0 | 1 | never |" in table


def test_twice_a_negative_return_is_no_goal(tmp_path: Path) -> None:
    (tmp_path / "agent.json").write_text('{"mean_return": -3.0}')
    with pytest.raises(BenchmarkError, match="mean return of -3, twice which is no more"):
        agent.wanted_return(agent.demonstrations(tmp_path))


def test_a_goal_that_is_none_is_refused_before_the_trainings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = agent.demonstrations(tmp_path)
    path.parent.mkdir()
    path.touch()
    (tmp_path / "agent.json").write_text('{"mean_return": 0.0}')
    assert main(["agent", "--out", str(tmp_path), "--steps", "1"]) == 2
    assert "mean return of 0, twice which is no more" in capsys.readouterr().err
    assert sorted(file.name for file in tmp_path.iterdir()) == ["agent.json", "demonstrations"]


@pytest.mark.slow
def test_an_agent_demonstrates_and_is_cloned(tmp_path: Path) -> None:
    parser = ArgumentParser()
    agent.add_arguments(parser)
    wanted = agent.runs(parser.parse_args(["--out", str(tmp_path), "--seeds", "3"]))
    path = agent.demonstrations(tmp_path)
    agent.make_demonstrations(path, steps=2048, n=8)
    for run in wanted:
        small = dict(run.hyperparams)
        if "demonstrations" in small:
            small["imitation_kwargs"] = CLONING
        train_one(
            replace(run, steps=2048, hyperparams=small, n_evaluations=1, n_episodes=1), tmp_path
        )
    table = agent.agent_table(load_results(tmp_path), 100.0)
    assert "| cloned | 1 | 2,048 |" in table
    assert "| scratch | 1 | 2,048 |" in table
