"""The paper's exploration maps: where in the maze three trainings go, on one color scale.

Trains what is missing, with every seed; draws the mean maps to ``pointmaze.png`` and writes their
numbers to ``pointmaze.md``.
"""

from collections.abc import Sequence
from pathlib import Path

from sb3_policyflow.benchmark.panels import Panel, over_seeds, panel_cells, panel_parser
from sb3_policyflow.benchmark.results import Result, load_results
from sb3_policyflow.benchmark.run import report_failures, run_cells
from sb3_policyflow.benchmark.table import markdown_table
from sb3_policyflow.benchmark.visits import VisitMap, density_figure
from sb3_policyflow.envs.point_maze import ENV_ID

HEADER = ("panel", "seeds", "free cells visited", "entropy of visits", "evaluation return")

PANELS = {
    "b-ppo": Panel("(b) PPO", "ppo", {}),
    "c-plain": Panel("(c) PolicyFlow", "policyflow", {"brownian_coef": 0.0}),
    "d-brownian": Panel("(d) PolicyFlow, Brownian", "policyflow", {"brownian_coef": 0.5}),
}
"""The paper's panels (b) to (d); its (a) is the maze itself. It gives no w_b: with 0.05, trainings
stay where PPO's do (docs/results.md)."""


def visits_table(seeds: dict[str, list[Result]], maps: dict[str, list[VisitMap]]) -> str:
    """A row for each panel: means over seeds, and the range where there are several.

    :param seeds: Results by panel.
    :param maps: Their visit maps, in the same order.
    """
    rows = [
        [
            PANELS[name].title,
            str(len(runs)),
            over_seeds([100 * each.coverage for each in maps[name]], digits=1) + " %",
            over_seeds([each.entropy for each in maps[name]]),
            over_seeds([run.summary["final"]["stochastic"]["mean_return"] for run in runs], 1),
        ]
        for name, runs in seeds.items()
    ]
    return markdown_table(HEADER, rows)


def draw(folder: Path, results: Sequence[Result]) -> None:
    """Write the figure and the table of what has been run."""
    seeds = {name: [run for run in results if run.cell.name == name] for name in PANELS}
    seeds = {name: runs for name, runs in seeds.items() if runs}
    maps = {
        name: [VisitMap.load(run.cell.path(folder, ".npz")) for run in runs]
        for name, runs in seeds.items()
    }
    density_figure({PANELS[name].title: maps[name] for name in maps}).savefig(
        folder / "pointmaze.png"
    )
    (folder / "pointmaze.md").write_text(visits_table(seeds, maps) + "\n", encoding="utf-8")


def main(argv: list[str]) -> int:
    """Train what is missing and make the figure."""
    arguments = panel_parser("pointmaze", __doc__, PANELS, steps=2e6).parse_args(argv)
    cells = panel_cells(PANELS, arguments, env=ENV_ID, keep_visits=True)
    failed = run_cells(cells, arguments.out, arguments.jobs, arguments.threads)
    code = report_failures(failed)
    draw(arguments.out, load_results(arguments.out))
    return code
