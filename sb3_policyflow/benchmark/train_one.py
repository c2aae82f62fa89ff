"""One training with rl_zoo3's own means, and what came of it."""

import argparse
import json
import shutil
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_policyflow.benchmark.errors import at_least
from sb3_policyflow.benchmark.experiment import make_experiment
from sb3_policyflow.benchmark.measure.costs import GradientSteps, network_evaluations
from sb3_policyflow.benchmark.measure.evaluation import STOCHASTIC, EvaluationCallback, evaluate
from sb3_policyflow.benchmark.measure.goals import GoalReport, goal_report, sample_trajectories
from sb3_policyflow.benchmark.measure.maze_goals import evaluate_maze_goals
from sb3_policyflow.benchmark.measure.provenance import versions
from sb3_policyflow.benchmark.measure.visits import VisitCounter
from sb3_policyflow.benchmark.results import PROGRESS, Result, Run
from sb3_policyflow.envs.point_maze import ENV_ID as MAZE

N_EVALUATION_ENVS = 10


class ProgressCallback(BaseCallback):
    """Writes to the log how far the training is, for the bar of the command that started it."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        share = self.num_timesteps / self.model._total_timesteps
        print(f"{PROGRESS}{min(share, 1.0):.0%}", flush=True)


def train_one(run: Run, folder: Path, agents: Path | None = None) -> Result:
    """Train as ``python -m rl_zoo3.train`` does, evaluate, and write the results.

    :param run: What to train.
    :param folder: Where the results go.
    :param agents: Where the trained agent goes, see :func:`keep_agent`.
    """
    with tempfile.TemporaryDirectory() as logs:
        settings = run.algo, run.env, run.steps, run.seed, logs, run.hyperparams
        manager, model, hyperparams = make_experiment(*settings)
        env = manager.create_envs(min(N_EVALUATION_ENVS, run.n_episodes), eval_env=True)
        due = np.linspace(0, run.steps, run.n_evaluations + 1)[1:].round().astype(int).tolist()
        evaluations = EvaluationCallback(env, due, run.n_episodes)
        # Only these need the extra ``robotics``.
        counters = [VisitCounter()] if run.keep_visits else []
        callbacks = [*manager.callbacks, ProgressCallback(), *counters]
        summary: dict[str, Any] = {
            "hyperparams": {key: str(value) for key, value in hyperparams.items()}
        }
        if "demonstrations" in run.hyperparams and run.n_trajectories:
            summary["cloned"] = evaluate(model, env, STOCHASTIC, run.n_episodes)
            summary["cloned"]["goals"] = _goals(model, run, folder, "-cloned.npz")
        summary |= train_and_measure(model, run.steps, evaluations, callbacks)
        for counter in counters:
            counter.visits().save(_archive(run, folder, ".npz"))
        if run.n_trajectories:
            summary["goals"] = _goals(model, run, folder, ".npz")
        if agents is not None:
            keep_agent(manager, model, agents)
        env.close()
        manager_env = model.get_env()
        assert manager_env is not None
        manager_env.close()
    result = Result(run, summary, evaluations.curve)
    result.save(folder)
    return result


def keep_agent(manager: ExperimentManager, model: OnPolicyAlgorithm, folder: Path) -> None:
    """Keep an agent where ``python -m rl_zoo3.enjoy -f FOLDER/seed-N`` finds it.

    :param manager: The experiment that trained it.
    :param model: The agent; it loses its optimizer's state, which takes two thirds of a file.
    :param folder: Where agents are.
    """
    model.policy.optimizer.state.clear()
    manager.save_trained_model(model)
    place = folder / f"seed-{manager.seed}" / manager.algo / f"{manager.env_name}_1"
    unwanted = shutil.ignore_patterns("*.monitor.csv", "command.txt")
    shutil.copytree(manager.save_path, place, ignore=unwanted, dirs_exist_ok=True)


def train_and_measure(
    model: OnPolicyAlgorithm,
    steps: int,
    evaluations: EvaluationCallback,
    callbacks: list[BaseCallback],
) -> dict[str, Any]:
    """Train, and say what it came to and what it took.

    :param model: The model.
    :param steps: Environment steps.
    :param evaluations: Evaluates it meanwhile.
    :param callbacks: More callbacks.
    """
    gradient_steps = GradientSteps(model)
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
        "network_evaluations": network_evaluations(model, gradient_steps.count),
        "parameters": sum(parameter.numel() for parameter in model.policy.parameters()),
        "seconds": {"training": seconds, "evaluation": evaluations.seconds},
        "threads": th.get_num_threads(),
        "versions": versions(),
    }


def _whole_rollouts(model: OnPolicyAlgorithm, steps: int) -> int:
    """The steps that are collected before there are ``steps`` of them.

    SB3 collects whole rollouts, but its schedules go by the number it was given: beyond that, a
    learning rate that falls to zero is less than zero.
    """
    rollout = model.n_steps * model.n_envs
    return -(-steps // rollout) * rollout


def _archive(run: Run, folder: Path, suffix: str) -> Path:
    """Where arrays of a run go; the folder is made."""
    path = run.path(folder, suffix)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _goals(model: OnPolicyAlgorithm, run: Run, folder: Path, suffix: str) -> dict[str, Any]:
    """Run episodes from one start, and say which goals they reached; MultiGoal's are kept."""
    if run.env == MAZE:
        report = evaluate_maze_goals(model, run.n_trajectories)
    else:
        report = _keep_trajectories(model, run, folder, suffix)
    return {**asdict(report), "n_goals": report.n_goals}


def _keep_trajectories(model: OnPolicyAlgorithm, run: Run, folder: Path, suffix: str) -> GoalReport:
    """Run episodes from the center of MultiGoal, and keep them."""
    trajectories = sample_trajectories(model, run.n_trajectories)
    np.savez_compressed(
        _archive(run, folder, suffix),
        positions=trajectories.positions.astype(np.float16),
        lengths=trajectories.lengths.astype(np.int16),
        returns=trajectories.returns.astype(np.float32),
    )
    return goal_report(trajectories)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("run", type=json.loads, help="the fields of a Run, as JSON")
    parser.add_argument("folder", type=Path, help="where the results go")
    parser.add_argument("--threads", type=at_least(1), default=1, help="threads of torch")
    parser.add_argument("--agents", type=Path, help="where the trained agent goes")


def main(arguments: argparse.Namespace) -> int:
    """Train as ``run_all`` asks for it."""
    th.set_num_threads(arguments.threads)
    train_one(Run(**arguments.run), arguments.folder, arguments.agents)
    return 0
