"""The paper's MultiGoal figure: six policies, 1000 trajectories each from the same point.

Trains what is missing, with every seed; draws the first seed's trajectories to ``multigoal.png``
and writes the table of all seeds to ``multigoal.md``.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_policyflow.benchmark.goals import Trajectories
from sb3_policyflow.benchmark.panels import Panel, over_seeds, panel_cells, panel_parser
from sb3_policyflow.benchmark.plots import goals_figure
from sb3_policyflow.benchmark.results import Cell, Result, distinct, load_results
from sb3_policyflow.benchmark.run import report_failures, run_cells
from sb3_policyflow.benchmark.table import markdown_table

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

PLAIN = ROLLOUTS | {"normalize_advantage": False, "brownian_coef": 0.0, "ent_coef": 0.0}
"""PolicyFlow without what keeps it from becoming narrow.

Advantages that are divided by their deviation would make much of the small differences that are
left between goals late in a training.
"""

PANELS = {
    "a-ppo": Panel("(a) PPO, Gaussian entropy", "ppo", ROLLOUTS | {"ent_coef": 0.001}),
    "b-dppo": Panel(
        "(b) DPPO", "dppo", ROLLOUTS | {"min_sampling_std": 0.1, "min_log_prob_std": 0.1}
    ),
    "c-fpo": Panel("(c) FPO", "fpo", ROLLOUTS | {"learning_rate": "lin_3e-4"}),
    "d-uniform": Panel(
        "(d) PolicyFlow, uniform noise",
        "policyflow",
        PLAIN | {"uniform_noise_coef": 0.05},
    ),
    "e-gaussian": Panel(
        "(e) PolicyFlow, Gaussian entropy",
        "policyflow",
        PLAIN | {"ent_coef": 0.001},
    ),
    "f-brownian": Panel(
        "(f) PolicyFlow, Brownian regularizer",
        "policyflow",
        PLAIN | {"brownian_coef": 0.2, "ent_coef": 0.001},
    ),
}
"""The paper's panels (a) to (f)."""


def load_trajectories(cell: Cell, folder: Path) -> Trajectories:
    """The episodes from the center that a cell kept."""
    with np.load(cell.path(folder, ".npz")) as kept:
        positions = kept["positions"].astype(np.float64)
        return Trajectories(positions, kept["lengths"].astype(int), kept["returns"])


def goals_table(results: Sequence[Result]) -> str:
    """A row for each panel: means over seeds, and the range where there are several."""
    rows = [
        _row(name, [result for result in results if result.cell.name == name])
        for name in distinct(results, "name")
    ]
    return markdown_table(HEADER, rows)


def _row(name: str, runs: Sequence[Result]) -> list[str]:
    goals = [run.summary["goals"] for run in runs]
    missed = [g["n_missed"] / (g["n_missed"] + sum(g["counts"])) for g in goals]
    return [
        PANELS[name].title if name in PANELS else name,
        str(len(runs)),
        over_seeds([g["mean_return"] for g in goals]),
        over_seeds([run.summary["final"]["stochastic"]["mean_return"] for run in runs]),
        over_seeds([g["n_goals"] for g in goals], digits=1),
        over_seeds([g["entropy"] for g in goals]),
        f"{np.mean(missed):.1%}",
        f"{np.mean([run.summary['gradient_steps'] for run in runs]):,.0f}",
        f"{np.mean([run.summary['seconds']['training'] for run in runs]) / 60:.1f}",
    ]


def draw(folder: Path, results: Sequence[Result]) -> None:
    """Write the figure of each panel's first seed, and the table of all."""
    first = {result.cell.name: result.cell for result in reversed(results)}
    runs = {
        PANELS[name].title: load_trajectories(first[name], folder)
        for name in PANELS
        if name in first
    }
    goals_figure(runs).savefig(folder / "multigoal.png")
    (folder / "multigoal.md").write_text(goals_table(results) + "\n", encoding="utf-8")


def main(argv: list[str]) -> int:
    """Train what is missing and make the figure."""
    arguments = panel_parser("multigoal", __doc__, PANELS, steps=3e6).parse_args(argv)
    cells = panel_cells(PANELS, arguments, env=ENV, n_trajectories=N_TRAJECTORIES)
    failed = run_cells(cells, arguments.out, arguments.jobs, arguments.threads)
    code = report_failures(failed)
    draw(arguments.out, load_results(arguments.out))
    return code
