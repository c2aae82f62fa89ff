"""MultiGoal from demonstrations: cloned, then trained further, by four algorithms.

Demonstrators go to all six goals, a good one and a slow one. Each algorithm starts from its own
clone. Makes the demonstrations, trains what is missing, with every seed; draws the first seed's
trajectories before and after to ``imitation.png`` and writes the table of all seeds to
``imitation.md``.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_policyflow.benchmark.figures.goals import goals_figure
from sb3_policyflow.benchmark.multigoal import ENV, N_TRAJECTORIES, ROLLOUTS, load_trajectories
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.report.statistics import over_seeds
from sb3_policyflow.benchmark.report.table import seeds_caption, steps_trained
from sb3_policyflow.benchmark.results import Result, Run, distinct, load_results
from sb3_policyflow.benchmark.run import add_running_arguments, run_and_report
from sb3_policyflow.imitation.demonstrators import demonstrate, make_env
from sb3_policyflow.imitation.episodes import save_episodes

HEADER = (
    "demonstrations",
    "algorithm",
    "seeds",
    "steps",
    "return cloned",
    "return trained",
    "center cloned",
    "center trained",
    "goals cloned",
    "goals trained",
    "entropy cloned",
    "entropy trained",
)
N_EPISODES = 16_384
"""Of each demonstrator: few of them pass the center, where the choice of a goal is learned."""
STEPS = {"good": 1e6, "slow": 5e6}
"""Environment steps of the training, by demonstrator."""

ALGORITHMS: dict[str, dict[str, Any]] = {
    "policyflow": {
        "desired_kl": None,
        "lr_adaptation_kwargs": None,
        "ent_coef": 0.0,
        "clip_range_vf": 100.0,
        "policy_kwargs": "dict(net_arch=[256, 128, 64], activation_fn=nn.Mish, embedding_dim=64)",
    },
    "fpo": {},
    "dppo": {},
    "ppo": {"policy_kwargs": "dict(net_arch=[256, 128, 64], activation_fn=nn.Mish)"},
}
"""What differs from the YAML files, by algorithm. Values of up to 10 are not clipped by 100."""
OF_POLICYFLOW: dict[str, dict[str, Any]] = {
    "good": {
        "learning_rate": "lin_5e-5",
        "normalize_advantage": False,
        "brownian_coef": 0.05,
        "imitation_kwargs": {"noise_std": 0.3},
    },
    "slow": {"learning_rate": 3e-4, "brownian_coef": 0.05, "imitation_kwargs": {"noise_std": 0.5}},
}
"""And by demonstrator. The noise explores, and from good demonstrations there is little to find.

What is nearly optimal has small advantages, which normalization would make large: goals are lost.
"""


def hyperparams(style: str, algo: str, folder: Path) -> dict[str, Any]:
    """What differs from the YAML file of an algorithm.

    :param style: The demonstrator.
    :param algo: The algorithm.
    :param folder: Where the demonstrations are.
    """
    chosen = {**ROLLOUTS, **ALGORITHMS[algo], "demonstrations": str(demonstrations(style, folder))}
    if algo != "ppo":
        chosen["n_critic_warmup"] = 12
    if algo == "policyflow":
        chosen |= OF_POLICYFLOW[style]
    return chosen


def demonstrations(style: str, folder: Path) -> Path:
    """The file of a demonstrator."""
    return folder / "demonstrations" / f"{style}.npz"


def make_demonstrations(style: str, folder: Path, n_episodes: int = N_EPISODES) -> None:
    """Make a demonstrator's file, unless it is there."""
    path = demonstrations(style, folder)
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_episodes(demonstrate(ENV, style, n_episodes), path, make_env(ENV, 1, 0))


def runs(arguments: argparse.Namespace) -> list[Run]:
    """The trainings that are wanted, seed after seed."""
    return [
        Run(
            f"{style}-{algo}",
            algo,
            ENV,
            seed,
            int(arguments.steps or STEPS[style]),
            hyperparams(style, algo, arguments.out),
            n_evaluations=arguments.evaluations,
            n_episodes=arguments.episodes,
            n_trajectories=N_TRAJECTORIES,
        )
        for seed in arguments.seeds
        for style in arguments.styles
        for algo in arguments.algos
    ]


def imitation_table(results: Sequence[Result]) -> str:
    """A row for each demonstrator and algorithm."""
    rows = [
        _row(name, [result for result in results if result.run.name == name])
        for name in distinct(results, "name")
    ]
    return f"{markdown_table(HEADER, rows)}\n\n{seeds_caption(results)}\n"


QUANTITIES = {"return": ".2f", "mean_return": ".2f", "n_goals": ".2g", "entropy": ".2f"}
"""Columns of the table, each before and after the training, with the digits that they have."""


def _row(name: str, results: Sequence[Result]) -> list[str]:
    style, algo = name.split("-")
    row = [style, algo, str(len(results)), steps_trained(results)]
    stages = [
        [
            {"return": evaluation["mean_return"], **goals}
            for evaluation, goals in (_stage(result.summary, is_trained) for result in results)
        ]
        for is_trained in (False, True)
    ]
    for quantity, digits in QUANTITIES.items():
        for stage in stages:
            values = [float(each[quantity]) for each in stage]
            row.append(over_seeds(values).format(digits))
    return row


def _stage(summary: dict[str, Any], is_trained: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """The evaluation from random starts, and the goals from the center, before or after."""
    if is_trained:
        return summary["final"]["stochastic"], summary["goals"]
    return summary["cloned"], summary["cloned"]["goals"]


def draw(folder: Path, results: Sequence[Result]) -> None:
    """Write the figure of each variant's first seed, and the table of all."""
    first = {result.run.name: result.run for result in reversed(results)}
    trajectories = {}
    for name in distinct(results, "name"):
        style, algo = name.split("-")
        title = f"{algo} from {style} demonstrations"
        trajectories[f"{title}: cloned"] = load_trajectories(first[name], folder, "-cloned.npz")
        trajectories[f"{title}: trained"] = load_trajectories(first[name], folder)
    goals_figure(trajectories, n_columns=4).savefig(folder / "imitation.png")
    (folder / "imitation.md").write_text(imitation_table(results), encoding="utf-8")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--styles", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--algos", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    parser.add_argument(
        "--steps", type=float, help="environment steps of each; default: 1e6 (good), 5e6 (slow)"
    )
    add_running_arguments(parser, Path("docs/results/imitation"))
    parser.set_defaults(episodes=200, evaluations=5)


def main(arguments: argparse.Namespace) -> int:
    """Make the demonstrations, train what is missing and make figure and table."""
    for style in arguments.styles:
        make_demonstrations(style, arguments.out)
    code = run_and_report(runs(arguments), arguments)
    draw(arguments.out, load_results(arguments.out))
    print(f"Wrote {arguments.out / 'imitation.png'} and {arguments.out / 'imitation.md'}.")
    return code
