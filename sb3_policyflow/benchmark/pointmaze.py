"""The paper's exploration maps: where in the maze three trainings go, on one color scale.

Trains what is missing, with every seed; draws the mean maps to ``pointmaze.png`` and writes their
numbers to ``pointmaze.md``. Needs the extra ``robotics``.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_policyflow.benchmark.errors import require_env
from sb3_policyflow.benchmark.figures.visits import density_figure
from sb3_policyflow.benchmark.measure.visits import VisitMap
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.report.statistics import over_seeds
from sb3_policyflow.benchmark.report.table import seeds_caption, steps_trained
from sb3_policyflow.benchmark.results import Result, load_results
from sb3_policyflow.benchmark.run import run_and_report
from sb3_policyflow.benchmark.variants import Variant, add_variant_arguments, variant_runs
from sb3_policyflow.envs.point_maze import ENV_ID

HEADER = ("panel", "seeds", "free cells visited, %", "entropy of visits", "evaluation return")

VARIANTS = {
    "b-ppo": Variant("(b) PPO", "ppo", {}),
    "c-plain": Variant("(c) PolicyFlow", "policyflow", {"brownian_coef": 0.0}),
    "d-brownian": Variant("(d) PolicyFlow, Brownian", "policyflow", {"brownian_coef": 0.5}),
}
"""The paper's panels (b) to (d); its (a) is the maze itself. It gives no w_b: with 0.05, trainings
stay where PPO's do (docs/results.md)."""


def visits_table(results: Sequence[Result], maps: dict[str, list[VisitMap]]) -> str:
    """A row for each variant.

    :param results: What was run.
    :param maps: Visit maps of each variant's seeds.
    """
    rows = []
    for name, visits in maps.items():
        finals = [r.summary["final"]["stochastic"] for r in results if r.run.name == name]
        rows.append(
            [
                VARIANTS[name].title,
                str(len(visits)),
                over_seeds([100 * each.coverage for each in visits]).format(".1f"),
                over_seeds([each.entropy for each in visits]).format(".3f"),
                over_seeds([final["mean_return"] for final in finals]).format(".1f"),
            ]
        )
    caption = f"{seeds_caption(results)} Environment steps: {steps_trained(results)}."
    return f"{markdown_table(HEADER, rows)}\n\n{caption}\n"


def draw(folder: Path, results: Sequence[Result]) -> None:
    """Write the figure and the table of what has been run."""
    results = [result for result in results if result.run.name in VARIANTS]
    maps: dict[str, list[VisitMap]] = {}
    for result in results:
        visits = VisitMap.load(result.run.path(folder, ".npz"))
        maps.setdefault(result.run.name, []).append(visits)
    figure = density_figure({VARIANTS[name].title: maps[name] for name in maps})
    figure.savefig(folder / "pointmaze.png")
    (folder / "pointmaze.md").write_text(visits_table(results, maps), encoding="utf-8")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_variant_arguments(parser, VARIANTS, steps=2e6, out=Path("docs/results/pointmaze"))


def main(arguments: argparse.Namespace) -> int:
    """Train what is missing and make the figure."""
    require_env(ENV_ID)
    runs = variant_runs(VARIANTS, arguments, env=ENV_ID, keep_visits=True)
    code = run_and_report(runs, arguments)
    draw(arguments.out, load_results(arguments.out))
    print(f"Wrote {arguments.out / 'pointmaze.png'} and {arguments.out / 'pointmaze.md'}.")
    return code
