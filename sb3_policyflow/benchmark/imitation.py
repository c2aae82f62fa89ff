"""Tasks with several goals from demonstrations: cloned, then trained further.

Demonstrators go to all goals: of MultiGoal a good one and a slow one, of the maze a good one. Each
algorithm starts from its own clone. Makes the demonstrations, trains what is missing, with every
seed, and writes the table of all seeds to ``TASK.md``; of MultiGoal it also draws the first seed's
trajectories before and after, to ``multigoal.png``.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_policyflow.benchmark.errors import BenchmarkError, at_least, require_env
from sb3_policyflow.benchmark.figures.goals import goals_figure
from sb3_policyflow.benchmark.measure.goals import GoalReport
from sb3_policyflow.benchmark.multigoal import (
    ENV,
    N_TRAJECTORIES,
    PAPER,
    ROLLOUTS,
    load_trajectories,
)
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.report.statistics import over_seeds
from sb3_policyflow.benchmark.report.table import seeds_caption, steps_trained
from sb3_policyflow.benchmark.results import Result, Run, distinct, load_results
from sb3_policyflow.benchmark.run import add_running_arguments, run_and_report
from sb3_policyflow.envs import point_maze
from sb3_policyflow.imitation.demonstrators import demonstrate, make_env
from sb3_policyflow.imitation.episodes import save_episodes

Hyperparams = Mapping[str, dict[str, Any]]


@dataclass(frozen=True)
class Task:
    """A task with demonstrators that go to all of its goals.

    :param env: Id of the environment.
    :param n_demonstrations: Episodes of each demonstrator.
    :param n_trajectories: Episodes from one start, of which the goals are counted.
    :param steps: Environment steps of the training, by demonstrator.
    :param algorithms: What differs from the YAML files, by algorithm and what follows "_":
        "dppo_last" trains the last half of DPPO's denoising steps.
    :param of_policyflow: And of PolicyFlow, by demonstrator.
    """

    env: str
    n_demonstrations: int
    n_trajectories: int
    steps: Mapping[str, float]
    algorithms: Hyperparams
    of_policyflow: Hyperparams = field(default_factory=dict)


MULTI_GOAL = Task(
    env=ENV,
    # Few of them pass the center, where the choice of a goal is learned.
    n_demonstrations=16_384,
    n_trajectories=N_TRAJECTORIES,
    steps={"good": 1e6, "slow": 5e6},
    algorithms={
        # Values of up to 10 are not clipped by 100.
        "policyflow": ROLLOUTS
        | PAPER
        | {
            "desired_kl": None,
            "lr_adaptation_kwargs": None,
            "ent_coef": 0.0,
            "clip_range_vf": 100.0,
            "policy_kwargs": "dict(net_arch=[256, 128, 64], activation_fn=nn.Mish, "
            "embedding_dim=64)",
        },
        "fpo": ROLLOUTS,
        "dppo": ROLLOUTS,
        "dppo_last": ROLLOUTS | {"n_finetuned_steps": 6},
        "ppo": ROLLOUTS | {"policy_kwargs": "dict(net_arch=[256, 128, 64], activation_fn=nn.Mish)"},
    },
    # The noise explores, and from good demonstrations there is little to find. What is nearly
    # optimal has small advantages, which normalization would make large: goals are lost.
    of_policyflow={
        "good": {
            "learning_rate": "lin_5e-5",
            "normalize_advantage": False,
            "brownian_coef": 0.05,
            "imitation_kwargs": {"noise_std": 0.3},
        },
        # What is left of the critic's error when the actor begins to learn decides between goals,
        # and so does the noise of advantages: a long warm-up, and a short horizon of lambda.
        "slow": {
            "n_critic_warmup": 60,
            "learning_rate": "lin_1.4e-4",
            "critic_learning_rate": "lin_1.4e-3",
            "gae_lambda": 0.8,
            "brownian_coef": "lin_0.15_0.1",
            "imitation_kwargs": {"noise_std": 0.5},
        },
    },
)
POINT_MAZE = Task(
    env=point_maze.ENV_ID,
    n_demonstrations=200,
    n_trajectories=200,
    steps={"good": 2e6},
    algorithms={"policyflow": {"brownian_coef": 0.05}, "ppo": {}},
    of_policyflow={"good": {"imitation_kwargs": {"noise_std": 0.3}}},
)
TASKS = {"multigoal": MULTI_GOAL, "pointmaze": POINT_MAZE}


def hyperparams(task: Task, style: str, algo: str, folder: Path) -> dict[str, Any]:
    """What differs from the YAML file of an algorithm.

    :param task: What is learned.
    :param style: The demonstrator.
    :param algo: The algorithm.
    :param folder: Where the demonstrations are.
    """
    chosen = {**task.algorithms[algo], "demonstrations": str(demonstrations(task, style, folder))}
    if algo != "ppo":
        chosen["n_critic_warmup"] = 12
    if algo == "policyflow":
        chosen |= task.of_policyflow.get(style, {})
    return chosen


def demonstrations(task: Task, style: str, folder: Path) -> Path:
    """The file of a demonstrator."""
    name = style if task is MULTI_GOAL else f"{task.env}-{style}"
    return folder / "demonstrations" / f"{name}.npz"


def make_demonstrations(
    task: Task, style: str, folder: Path, n_episodes: int | None = None
) -> None:
    """Make a demonstrator's file, unless it is there."""
    path = demonstrations(task, style, folder)
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        episodes = demonstrate(task.env, style, n_episodes or task.n_demonstrations)
        save_episodes(episodes, path, make_env(task.env, 1, 0))


def runs(arguments: argparse.Namespace) -> list[Run]:
    """The trainings that are wanted, seed after seed."""
    task = TASKS[arguments.task]
    return [
        Run(
            f"{style}-{algo}",
            algo.partition("_")[0],
            task.env,
            seed,
            int(arguments.steps or task.steps[style]),
            hyperparams(task, style, algo, arguments.out),
            n_evaluations=arguments.evaluations,
            n_episodes=arguments.episodes,
            n_trajectories=task.n_trajectories,
        )
        for seed in arguments.seeds
        for style in chosen_styles(arguments)
        for algo in arguments.algos or task.algorithms
    ]


def chosen_styles(arguments: argparse.Namespace) -> Sequence[str]:
    """The demonstrators that are asked for."""
    return arguments.styles or list(TASKS[arguments.task].steps)


HEADER = ("demonstrations", "algorithm", "seeds", "steps")
QUANTITIES = {
    "return": ".2f",
    "return from one start": ".2f",
    "goals": ".2g",
    "entropy": ".2f",
    "no goal, %": ".1f",
}
"""Columns of the table, each before and after the training, with the digits that they have."""


def imitation_table(results: Sequence[Result]) -> str:
    """A row for each demonstrator and algorithm."""
    columns = [f"{name}: {stage}" for name in QUANTITIES for stage in ("cloned", "trained")]
    rows = [
        _row(name, [result for result in results if result.run.name == name])
        for name in distinct(results, "name")
    ]
    return f"{markdown_table([*HEADER, *columns], rows)}\n\n{seeds_caption(results)}\n"


def _row(name: str, results: Sequence[Result]) -> list[str]:
    style, algo = name.split("-")
    before, after = (
        [_quantities(result, is_trained) for result in results] for is_trained in (False, True)
    )
    numbers = [
        over_seeds([each[quantity] for each in stage]).format(digits)
        for quantity, digits in QUANTITIES.items()
        for stage in (before, after)
    ]
    return [style, algo, str(len(results)), steps_trained(results), *numbers]


def _quantities(result: Result, is_trained: bool) -> dict[str, float]:
    """What the table says of a run, before or after its training."""
    summary = result.summary
    evaluation = summary["final"]["stochastic"] if is_trained else summary["cloned"]
    goals = GoalReport.from_summary((summary if is_trained else summary["cloned"])["goals"])
    values = (
        evaluation["mean_return"],
        goals.mean_return,
        goals.n_goals,
        goals.entropy,
        100 * goals.share_missed,
    )
    return dict(zip(QUANTITIES, map(float, values), strict=True))


def draw(folder: Path, results: Sequence[Result]) -> None:
    """Write the table of each task that has been run, and MultiGoal's figure."""
    for name, task in TASKS.items():
        own = [result for result in results if result.run.env == task.env]
        if own:
            (folder / f"{name}.md").write_text(imitation_table(own), encoding="utf-8")
        if own and task is MULTI_GOAL:
            _draw_trajectories(folder, own)


def _draw_trajectories(folder: Path, results: Sequence[Result]) -> None:
    """MultiGoal's figure, of each variant's first seed."""
    first = {result.run.name: result.run for result in reversed(results)}
    trajectories = {}
    for name in distinct(results, "name"):
        style, algo = name.split("-")
        title = f"{algo}, {style}"
        trajectories[f"{title}: cloned"] = load_trajectories(first[name], folder, "-cloned.npz")
        trajectories[f"{title}: trained"] = load_trajectories(first[name], folder)
    goals_figure(trajectories, n_columns=4).savefig(folder / "multigoal.png")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--task", choices=TASKS, default="multigoal", help="default: multigoal")
    parser.add_argument("--styles", nargs="+", choices=MULTI_GOAL.steps, help="default: all")
    parser.add_argument("--algos", nargs="+", choices=MULTI_GOAL.algorithms, help="default: all")
    parser.add_argument(
        "--steps",
        type=at_least(1, float),
        help="environment steps of each; default: 1e6 (good), 5e6 (slow), 2e6 (pointmaze)",
    )
    add_running_arguments(parser, Path("docs/results/imitation"))
    parser.set_defaults(episodes=200, evaluations=5)


def main(arguments: argparse.Namespace) -> int:
    """Make the demonstrations, train what is missing and make figure and tables."""
    task = TASKS[arguments.task]
    check_choices(arguments)
    require_env(task.env)
    for style in chosen_styles(arguments):
        make_demonstrations(task, style, arguments.out)
    code = run_and_report(runs(arguments), arguments)
    draw(arguments.out, load_results(arguments.out))
    print(f"The tables are in {arguments.out}.")
    return code


def check_choices(arguments: argparse.Namespace) -> None:
    """Refuse demonstrators and algorithms that a task does not have.

    :raises BenchmarkError: With those that it has.
    """
    task = TASKS[arguments.task]
    for option, asked, there in (
        ("--styles", arguments.styles, task.steps),
        ("--algos", arguments.algos, task.algorithms),
    ):
        unknown = [name for name in asked or [] if name not in there]
        if unknown:
            raise BenchmarkError(
                f"{option} {' '.join(unknown)}: the task {arguments.task} has {', '.join(there)}."
            )
