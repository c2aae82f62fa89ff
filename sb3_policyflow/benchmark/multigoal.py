"""The paper's MultiGoal figure: six policies, 1000 trajectories each from the same point.

Trains what is missing, with every seed; draws the first seed's trajectories to ``multigoal.png``
and writes the table of all seeds to ``multigoal.md``.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_policyflow.benchmark.figures.goals import goals_figure
from sb3_policyflow.benchmark.measure.goals import GoalReport, Trajectories
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.report.statistics import over_seeds
from sb3_policyflow.benchmark.report.table import seeds_caption, steps_trained
from sb3_policyflow.benchmark.results import Result, Run, distinct, load_results
from sb3_policyflow.benchmark.run import run_and_report
from sb3_policyflow.benchmark.variants import Variant, add_variant_arguments, variant_runs

ENV = "MultiGoal-v0"
N_TRAJECTORIES = 1000
HEADER = (
    "panel",
    "seeds",
    "return from the center",
    "evaluation return",
    "goals of 6",
    "entropy",
    "no goal",
    "gradient steps",
    "minutes",
)

ROLLOUTS = {"n_envs": 1024, "n_steps": 24, "batch_size": 1536, "n_epochs": 5}
"""Alike for all; smaller minibatches than the paper's 6144 do all of them good."""

PAPER = {"gae_lambda": 0.95, "clip_range_vf": 0.2, "critic_learning_rate": None}
"""The paper's, where those of ``policyflow.yml``, which are made for the demo, are others."""

PLAIN = ROLLOUTS | PAPER | {"normalize_advantage": False, "brownian_coef": 0.0, "ent_coef": 0.0}
"""PolicyFlow without what keeps it from becoming narrow.

Advantages that are divided by their deviation would make much of the small differences that are
left between goals late in a training.
"""

VARIANTS = {
    "a-ppo": Variant("(a) PPO, Gaussian entropy", "ppo", ROLLOUTS | {"ent_coef": 0.001}),
    "b-dppo": Variant(
        "(b) DPPO", "dppo", ROLLOUTS | {"min_sampling_std": 0.1, "min_log_prob_std": 0.1}
    ),
    "c-fpo": Variant("(c) FPO", "fpo", ROLLOUTS | {"learning_rate": "lin_3e-4"}),
    "d-uniform": Variant(
        "(d) PolicyFlow, uniform noise",
        "policyflow",
        PLAIN | {"uniform_noise_coef": 0.05},
    ),
    "e-gaussian": Variant(
        "(e) PolicyFlow, Gaussian entropy",
        "policyflow",
        PLAIN | {"ent_coef": 0.001},
    ),
    "f-brownian": Variant(
        "(f) PolicyFlow, Brownian regularizer",
        "policyflow",
        PLAIN | {"brownian_coef": 0.2, "ent_coef": 0.001},
    ),
}
"""The paper's panels (a) to (f)."""


def load_trajectories(run: Run, folder: Path, suffix: str = ".npz") -> Trajectories:
    """The episodes from the center that a run kept.

    :param run: The run.
    :param folder: Where its results are.
    :param suffix: "-cloned.npz" for those before the training.
    """
    with np.load(run.path(folder, suffix)) as kept:
        positions = kept["positions"].astype(np.float64)
        return Trajectories(positions, kept["lengths"].astype(int), kept["returns"])


def goals_table(results: Sequence[Result]) -> str:
    """A row for each variant."""
    rows = [
        _row(name, [result for result in results if result.run.name == name])
        for name in distinct(results, "name")
    ]
    caption = f"{seeds_caption(results)} Environment steps: {steps_trained(results)}."
    return f"{markdown_table(HEADER, rows)}\n\n{caption}\n"


def _row(name: str, results: Sequence[Result]) -> list[str]:
    summaries = [result.summary for result in results]
    goals = [GoalReport.from_summary(summary["goals"]) for summary in summaries]
    return [
        VARIANTS[name].title if name in VARIANTS else name,
        str(len(results)),
        over_seeds([g.mean_return for g in goals]).format(".2f"),
        over_seeds([s["final"]["stochastic"]["mean_return"] for s in summaries]).format(".2f"),
        over_seeds([g.n_goals for g in goals]).format(".2g"),
        over_seeds([g.entropy for g in goals]).format(".2f"),
        f"{np.mean([g.share_missed for g in goals]):.1%}",
        f"{np.mean([summary['gradient_steps'] for summary in summaries]):,.0f}",
        f"{np.mean([summary['seconds']['training'] for summary in summaries]) / 60:.1f}",
    ]


def draw(folder: Path, results: Sequence[Result]) -> None:
    """Write the figure of each variant's first seed, and the table of all."""
    first = {result.run.name: result.run for result in reversed(results)}
    differ = len({run.steps for run in first.values()}) > 1
    trajectories = {
        variant.title + (f"\n{run.steps / 1e6:g} M steps" if differ else ""): load_trajectories(
            run, folder
        )
        for name, variant in VARIANTS.items()
        if (run := first.get(name)) is not None
    }
    goals_figure(trajectories).savefig(folder / "multigoal.png")
    (folder / "multigoal.md").write_text(goals_table(results), encoding="utf-8")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_variant_arguments(parser, VARIANTS, steps=3e6, out=Path("docs/results/multigoal"))


def main(arguments: argparse.Namespace) -> int:
    """Train what is missing and make the figure."""
    runs = variant_runs(VARIANTS, arguments, env=ENV, n_trajectories=N_TRAJECTORIES)
    code = run_and_report(runs, arguments)
    draw(arguments.out, load_results(arguments.out))
    print(f"Wrote {arguments.out / 'multigoal.png'} and {arguments.out / 'multigoal.md'}.")
    return code
