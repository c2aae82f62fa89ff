"""Train PolicyFlow on MultiGoal and show which goals it reaches.

Writes ``trajectories.png``, ``learning_curve.png``, ``progress.csv`` and ``model.zip``.
"""

import argparse
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_policyflow.benchmark.experiment import make_experiment
from sb3_policyflow.benchmark.figures.goals import goals_figure
from sb3_policyflow.benchmark.figures.progress import progress_figure
from sb3_policyflow.benchmark.measure.goals import (
    evaluate_goals,
    goal_report,
    sample_trajectories,
)

ENV = "MultiGoal-v0"
N_TRAJECTORIES = 1000
EVALUATE_EVERY = 500_000


class GoalsCallback(BaseCallback):
    """Logs, from time to time, which goals are reached from the center.

    :param every: Environment steps between evaluations.
    """

    def __init__(self, every: int) -> None:
        super().__init__()
        self._every = every
        self._due = every

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps < self._due:
            return
        self._due += self._every
        report = evaluate_goals(self.model, N_TRAJECTORIES)
        self.logger.record("goals/reached", report.n_goals)
        self.logger.record("goals/entropy", report.entropy)
        self.logger.record("goals/mean_return", report.mean_return)


def train(seed: int, steps: int | None, folder: Path) -> OnPolicyAlgorithm:
    """Train with the hyperparameters of ``policyflow.yml`` and SB3's progress bar.

    :param seed: Seed of the training.
    :param steps: Environment steps; those of the YAML file if not given.
    :param folder: Where the log and the model go.
    """
    experiment = make_experiment("policyflow", ENV, steps, seed, str(folder))
    setup = experiment.setup_experiment()
    assert setup is not None
    model = setup[0]
    assert isinstance(model, OnPolicyAlgorithm)
    model.set_logger(configure(str(folder), ["csv"]))
    model.learn(experiment.n_timesteps, GoalsCallback(EVALUATE_EVERY), progress_bar=True)
    model.save(folder / "model")
    return model


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--steps", type=float, help="environment steps; default: the YAML file's")
    parser.add_argument("--out", type=Path, default=Path("demo"), help="default: demo")


def main(arguments: argparse.Namespace) -> int:
    """Train, sample, draw and report."""
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    steps = None if arguments.steps is None else int(arguments.steps)
    model = train(arguments.seed, steps, folder)
    trajectories = sample_trajectories(model, N_TRAJECTORIES)
    goals_figure({"PolicyFlow": trajectories}).savefig(folder / "trajectories.png")
    progress_figure(folder / "progress.csv").savefig(folder / "learning_curve.png")
    assert model.ep_info_buffer is not None
    training_return = np.mean([episode["r"] for episode in model.ep_info_buffer])
    print(
        f"After {model.num_timesteps:,} steps the training return is {training_return:.2f}.\n"
        f"{N_TRAJECTORIES} stochastic trajectories from the center: {goal_report(trajectories)}.\n"
        f"Pictures: {folder / 'trajectories.png'} and {folder / 'learning_curve.png'}."
    )
    return 0
