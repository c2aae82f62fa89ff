"""One training with rl_zoo3's own means, and what came of it."""

import argparse
import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_policyflow.benchmark import costs
from sb3_policyflow.benchmark.evaluation import EvaluationCallback
from sb3_policyflow.benchmark.experiment import make_experiment
from sb3_policyflow.benchmark.goals import goal_report, sample_trajectories
from sb3_policyflow.benchmark.results import Cell, Result

if TYPE_CHECKING:
    from sb3_policyflow.benchmark.visits import VisitCounter

N_EVALUATION_ENVS = 10


def train_cell(cell: Cell, folder: Path) -> Result:
    """Train as ``python -m rl_zoo3.train`` does, evaluate, and write the results.

    :param cell: What to train.
    :param folder: Where the results go.
    """
    with tempfile.TemporaryDirectory() as logs:
        manager = make_experiment(
            cell.algo, cell.env, cell.steps, cell.seed, logs, cell.hyperparams
        )
        setup = manager.setup_experiment()
        assert setup is not None
        model, hyperparams = setup
        assert isinstance(model, OnPolicyAlgorithm)
        env = manager.create_envs(min(N_EVALUATION_ENVS, cell.n_episodes), eval_env=True)
        evaluations = EvaluationCallback(env, _due(cell), cell.n_episodes)
        counters = _visit_counters(cell)
        callbacks = [*manager.callbacks, *counters]
        summary = {
            "hyperparams": {key: str(value) for key, value in hyperparams.items()},
            **_train(model, cell.steps, evaluations, callbacks),
        }
        for counter in counters:
            counter.visits().save(_archive(cell, folder))
        if cell.n_trajectories:
            summary["goals"] = _keep_trajectories(model, cell, folder)
        env.close()
        manager_env = model.get_env()
        assert manager_env is not None
        manager_env.close()
    result = Result(cell, summary, evaluations.curve)
    result.save(folder)
    return result


def _due(cell: Cell) -> list[int]:
    """When to evaluate."""
    timesteps = np.linspace(0, cell.steps, cell.n_evaluations + 1)[1:]
    return [round(value) for value in timesteps]


def _train(
    model: OnPolicyAlgorithm,
    steps: int,
    evaluations: EvaluationCallback,
    callbacks: list[BaseCallback],
) -> dict[str, Any]:
    """Train, and say what it came to and what it took."""
    gradient_steps = costs.GradientSteps(model)
    start = time.perf_counter()
    model.learn(
        _whole_rollouts(model, steps),
        callback=[*callbacks, evaluations],
        log_interval=None,  # type: ignore[arg-type]  # SB3 takes None
    )
    seconds = time.perf_counter() - start - evaluations.seconds
    last = evaluations.curve[-1]["timesteps"]
    final = {row["mode"]: row for row in evaluations.curve if row["timesteps"] == last}
    return {
        "final": final,
        "timesteps": model.num_timesteps,
        "gradient_steps": gradient_steps.count,
        "network_evaluations": costs.network_evaluations(model, gradient_steps.count),
        "parameters": sum(parameter.numel() for parameter in model.policy.parameters()),
        "seconds": {"training": seconds, "evaluation": evaluations.seconds},
        "threads": th.get_num_threads(),
        "versions": costs.versions(),
    }


def _whole_rollouts(model: OnPolicyAlgorithm, steps: int) -> int:
    """The steps that are collected before there are ``steps`` of them.

    SB3 collects whole rollouts, but its schedules go by the number it was given: beyond that, a
    learning rate that falls to zero is less than zero.
    """
    rollout = model.n_steps * model.n_envs
    return -(-steps // rollout) * rollout


def _visit_counters(cell: Cell) -> list["VisitCounter"]:
    """What counts visits, if they are to be kept; only this needs the extra ``robotics``."""
    if not cell.keep_visits:
        return []
    from sb3_policyflow.benchmark.visits import VisitCounter

    return [VisitCounter()]


def _archive(cell: Cell, folder: Path) -> Path:
    """Where arrays of a cell go; the folder is made."""
    path = cell.path(folder, ".npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _keep_trajectories(model: OnPolicyAlgorithm, cell: Cell, folder: Path) -> dict[str, Any]:
    """Run episodes from the center of MultiGoal, keep them, and say which goals they reached."""
    trajectories = sample_trajectories(model, cell.n_trajectories)
    report = goal_report(trajectories)
    np.savez_compressed(
        _archive(cell, folder),
        positions=trajectories.positions.astype(np.float16),
        lengths=trajectories.lengths.astype(np.int16),
        returns=trajectories.returns.astype(np.float32),
    )
    return {**asdict(report), "n_goals": report.n_goals}


def main(argv: list[str]) -> int:
    """Train the cell that a JSON text describes."""
    parser = argparse.ArgumentParser(prog="python -m sb3_policyflow.benchmark cell")
    parser.add_argument("cell", help="the cell's fields, as JSON")
    parser.add_argument("folder", type=Path, help="where the results go")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    arguments = parser.parse_args(argv)
    th.set_num_threads(arguments.threads)
    train_cell(Cell(**json.loads(arguments.cell)), arguments.folder)
    return 0
