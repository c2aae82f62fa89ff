"""Train PolicyFlow on MultiGoal and show which goals it reaches.

Writes ``trajectories.png``, ``learning_curve.png``, ``progress.csv`` and ``model.zip``.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from tqdm import tqdm

from sb3_policyflow.benchmark.errors import BenchmarkError, at_least
from sb3_policyflow.benchmark.experiment import make_experiment
from sb3_policyflow.benchmark.figures.goals import goals_figure
from sb3_policyflow.benchmark.figures.progress import progress_figure
from sb3_policyflow.benchmark.measure.goals import (
    evaluate_goals,
    goal_report,
    sample_trajectories,
)

ENV = "MultiGoal-v0"
STEPS = 10_000_000
"""Fewer than the YAML file's 14 million: with the installation they take up to
twelve minutes on two cores."""
N_TRAJECTORIES = 1000
EVALUATE_EVERY = 500_000


class GoalsCallback(BaseCallback):
    """Shows the progress of a training, and from time to time which goals its policy reaches.

    :param every: Environment steps between evaluations.
    """

    def __init__(self, every: int) -> None:
        super().__init__()
        self._every = every
        self._due = every

    def _on_training_start(self) -> None:
        self.bar: tqdm[Any] = tqdm(
            total=self.model._total_timesteps, unit="step", unit_scale=True, dynamic_ncols=True
        )
        self.bar.set_description("first rollout")

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.bar.set_description("training")
        if self.model.ep_info_buffer:
            self.bar.set_postfix_str(f"return {training_return(self.model):.2f}")
        self.bar.update(min(self.num_timesteps, int(self.bar.total)) - self.bar.n)
        if self.num_timesteps < self._due:
            return
        self._due += self._every
        report = evaluate_goals(self.model, N_TRAJECTORIES)
        self.logger.record("goals/reached", report.n_goals)
        self.logger.record("goals/entropy", report.entropy)
        self.logger.record("goals/mean_return", report.mean_return)
        self.bar.write(f"{self.num_timesteps / 1e6:5.1f} M steps: {report}")

    def close(self) -> None:
        """End the bar, also if the training was interrupted."""
        self.bar.close()


def training_return(model: Any) -> float:
    """Mean return of the last 100 episodes of the training; NaN if there are none."""
    episodes = model.ep_info_buffer or ()
    return float(np.mean([episode["r"] for episode in episodes])) if episodes else float("nan")


def train(seed: int, steps: int, folder: Path) -> tuple[OnPolicyAlgorithm, bool]:
    """Train with the hyperparameters of ``policyflow.yml``; Ctrl-C ends it early.

    :param seed: Seed of the training.
    :param steps: Environment steps.
    :param folder: Where the log and the model go.
    :return: The model, and whether its training is complete.
    """
    manager, model, _ = make_experiment("policyflow", ENV, steps, seed, str(folder))
    model.set_logger(configure(str(folder), ["csv"]))
    progress, complete = GoalsCallback(EVALUATE_EVERY), True
    try:
        model.learn(manager.n_timesteps, progress)
    except KeyboardInterrupt:
        complete = False
    finally:
        progress.close()
    model.save(folder / "model")
    return model, complete


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--seed", type=at_least(0), default=0, help="default: 0")
    parser.add_argument(
        "--steps",
        type=at_least(1, float),
        default=STEPS,
        help="environment steps; default: 10 million",
    )
    parser.add_argument("--out", type=Path, default=Path("demo"), help="a folder; default: demo")


def main(arguments: argparse.Namespace) -> int:
    """Train, sample, draw and report."""
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    model, complete = train(arguments.seed, int(arguments.steps), folder)
    if not complete:
        print(f"Stopped after {model.num_timesteps:,} steps. Kept: {folder / 'model.zip'}.")
        return 130
    trajectories = sample_trajectories(model, N_TRAJECTORIES)
    goals_figure({"PolicyFlow": trajectories}).savefig(folder / "trajectories.png")
    written = [folder / "model.zip", folder / "trajectories.png"]
    try:
        progress_figure(folder / "progress.csv").savefig(folder / "learning_curve.png")
        written.append(folder / "learning_curve.png")
    except BenchmarkError as error:  # so short a training has no curve
        print(error)
    print(
        f"After {model.num_timesteps:,} steps, return in training: {training_return(model):.2f}.\n"
        f"{N_TRAJECTORIES} stochastic trajectories from the center: {goal_report(trajectories)}.\n"
        f"Wrote {', '.join(map(str, written))}."
    )
    return 0
