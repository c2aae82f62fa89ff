"""Learning curves of what was run, and how often one algorithm does better than another.

From five seeds on a curve is the interquartile mean and its band the 95 % bootstrap interval; of
fewer seeds, they are the mean, and minimum and maximum.
"""

import argparse
import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.benchmark.figures.style import (
    DPI,
    GRAY,
    SERIES_COLORS,
    series_styles,
    style_curves,
)
from sb3_policyflow.benchmark.measure.evaluation import MODES, STOCHASTIC
from sb3_policyflow.benchmark.report.statistics import (
    MIN_SEEDS,
    over_seeds,
    share_of_pairs,
    stratified_bootstrap,
)
from sb3_policyflow.benchmark.report.table import paired_scores
from sb3_policyflow.benchmark.results import (
    DEFAULT_FOLDER,
    Result,
    distinct,
    load_results,
    select,
)
from sb3_policyflow.envs.drawing import INK

MOST_COLUMNS = 3


def curves_figure(results: Sequence[Result], mode: str = STOCHASTIC) -> Figure:
    """A panel for each environment, a line for each name; the legend is below all panels.

    :param results: What was run.
    :param mode: How the evaluated policies acted.
    :raises BenchmarkError: If the seeds of a name were evaluated at different timesteps.
    """
    envs, names = distinct(results, "env"), distinct(results, "name")
    styles = series_styles(names)
    n_columns = min(MOST_COLUMNS, math.ceil(math.sqrt(len(envs))))
    n_rows = -(-len(envs) // n_columns)
    figure = Figure(figsize=(4.2 * n_columns, 3.2 * n_rows), dpi=DPI, layout="constrained")
    panels = np.ravel(figure.subplots(n_rows, n_columns, squeeze=False))
    for axes, env in zip(panels, envs, strict=False):
        for name, style in styles.items():
            _draw_curve(axes, select(results, name, env), mode, *style)
        style_curves(axes, env)
    for axes in panels[len(envs) :]:
        axes.set_visible(False)
    if len(names) > 1:
        lines = [
            Line2D([], [], color=color, marker=marker, markersize=5, linewidth=1.8)
            for color, marker in styles.values()
        ]
        figure.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False)
    return figure


def _draw_curve(axes: Axes, results: Sequence[Result], mode: str, color: str, marker: str) -> None:
    curves = [curve for result in results if (curve := result.returns(mode))[0]]
    if not curves:
        return
    run, timesteps = results[0].run, curves[0][0]
    if any(curve[0] != timesteps for curve in curves):
        raise BenchmarkError(
            f"The seeds of {run.name} in {run.env} were not evaluated at the same timesteps, so "
            "there is no curve of them: keep trainings of different lengths in different folders."
        )
    estimate = over_seeds([returns for _, returns in curves])
    line: dict[str, Any] = {"color": color, "marker": marker, "markersize": 5, "linewidth": 1.8}
    axes.plot(timesteps, estimate.value, label=run.name, **line)
    axes.set_xlim(left=0)
    if len(curves) > 1:
        axes.fill_between(
            timesteps, estimate.low, estimate.high, color=color, alpha=0.13, linewidth=0
        )


def comparison_figure(results: Sequence[Result], mode: str = STOCHASTIC) -> Figure:
    """A dot for each pair of names: how often the first does better, over all environments.

    From five seeds on it is on a bar, the 95 % interval.
    """
    pairs = []
    for name, other in combinations(distinct(results, "name"), 2):
        scores = paired_scores(results, name, other, mode)
        if scores is not None:
            pairs.append((f"{name} > {other}", scores))
    figure = Figure(figsize=(5.6, 0.7 + 0.4 * len(pairs)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    for place, (label, scores) in enumerate(reversed(pairs)):
        if min(map(len, scores)) >= MIN_SEEDS:
            estimate = stratified_bootstrap(share_of_pairs, *scores)
            ends = [float(estimate.low), float(estimate.high)]
            axes.plot(ends, [place, place], color=GRAY, linewidth=6)
        share = float(share_of_pairs(*scores))
        axes.plot(share, place, "o", color=SERIES_COLORS[0], clip_on=False)
        axes.text(-0.03, place, label, ha="right", va="center", fontsize=8, color=INK)
    axes.axvline(0.5, color=GRAY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.set(xlim=(0, 1), ylim=(-0.6, len(pairs) - 0.4), yticks=[])
    axes.set_xlabel("share of pairs of runs", fontsize=9, color=INK)
    axes.spines[["left", "top", "right"]].set_visible(False)
    return figure


def write_figures(results: Sequence[Result], folder: Path, mode: str = STOCHASTIC) -> list[Path]:
    """Write ``curves.png`` and, for more than one name, ``improvement.png``.

    :return: What was written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {folder / "curves.png": curves_figure(results, mode)}
    if len(distinct(results, "name")) > 1:
        figures[folder / "improvement.png"] = comparison_figure(results, mode)
    for path, figure in figures.items():
        figure.savefig(path)
    return list(figures)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "folder", type=Path, nargs="?", default=DEFAULT_FOLDER, help="what `run` has written"
    )
    parser.add_argument("--out", type=Path, help="a folder; that of the results if not given")
    parser.add_argument(
        "--mode", choices=MODES, default=STOCHASTIC, help="how policies acted; default: %(default)s"
    )


def main(arguments: argparse.Namespace) -> int:
    """Draw what a folder has."""
    results = load_results(arguments.folder)
    written = write_figures(results, arguments.out or arguments.folder, arguments.mode)
    print(f"Wrote {' and '.join(map(str, written))}.")
    return 0
