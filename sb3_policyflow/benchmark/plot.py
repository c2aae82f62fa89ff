"""Learning curves and probabilities of improvement of what was run.

A curve is the interquartile mean over seeds, its band the 95 % bootstrap interval.
"""

import argparse
import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sb3_policyflow.benchmark.evaluation import DETERMINISTIC, LATENT_ONLY, STOCHASTIC
from sb3_policyflow.benchmark.plots import DPI, GRAY, SERIES_COLORS, style_curves
from sb3_policyflow.benchmark.results import Result, ResultsError, distinct, load_results, select
from sb3_policyflow.benchmark.run import DEFAULT_FOLDER
from sb3_policyflow.benchmark.statistics import bootstrap_interval, interquartile_mean, score_matrix
from sb3_policyflow.benchmark.table import improvement
from sb3_policyflow.envs.drawing import INK

MOST_COLUMNS = 3


def curves_figure(results: Sequence[Result], mode: str = STOCHASTIC) -> Figure:
    """A panel for each environment, a line for each name; the legend is below all panels."""
    envs, names = distinct(results, "env"), distinct(results, "name")
    n_columns = min(MOST_COLUMNS, math.ceil(math.sqrt(len(envs))))
    n_rows = -(-len(envs) // n_columns)
    figure = Figure(figsize=(4.2 * n_columns, 3.2 * n_rows), dpi=DPI, layout="constrained")
    panels = np.ravel(figure.subplots(n_rows, n_columns, squeeze=False))
    for axes, env in zip(panels, envs, strict=False):
        for name, color in zip(names, _colors(len(names)), strict=True):
            _draw_curve(axes, select(results, name, env), mode, color)
        style_curves(axes, env)
    for axes in panels[len(envs) :]:
        axes.set_visible(False)
    if len(names) > 1:
        lines = [Line2D([], [], color=color, linewidth=1.8) for color in _colors(len(names))]
        figure.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False)
    return figure


def _colors(n_names: int) -> list[str]:
    return [SERIES_COLORS[i % len(SERIES_COLORS)] for i in range(n_names)]


def _draw_curve(axes: Axes, runs: Sequence[Result], mode: str, color: str) -> None:
    curves = [run.returns(mode) for run in runs]
    curves = [curve for curve in curves if curve[0]]
    if not curves:
        return
    timesteps = curves[0][0]
    if any(curve[0] != timesteps for curve in curves):
        cell = runs[0].cell
        raise ResultsError(
            f"The seeds of {cell.name} in {cell.env} were not evaluated at the same timesteps, so "
            "there is no curve of them: keep trainings of different lengths in different folders."
        )
    points = [score_matrix([list(scores)]) for scores in zip(*(c[1] for c in curves), strict=True)]
    intervals = np.array([bootstrap_interval(interquartile_mean, scores) for scores in points])
    axes.plot(timesteps, intervals[:, 0], color=color, linewidth=1.8, label=runs[0].cell.name)
    if len(curves) > 1:
        axes.fill_between(
            timesteps, intervals[:, 1], intervals[:, 2], color=color, alpha=0.18, linewidth=0
        )


def improvement_figure(results: Sequence[Result], mode: str = STOCHASTIC) -> Figure:
    """A bar for each pair of names: how likely the first does better, over all environments."""
    pairs = []
    for name, other in combinations(distinct(results, "name"), 2):
        interval = improvement(results, name, other, mode)
        if interval is not None:
            pairs.append((f"{name} > {other}", interval))
    figure = Figure(figsize=(5.6, 0.7 + 0.4 * len(pairs)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    for place, (label, interval) in enumerate(reversed(pairs)):
        axes.plot([interval.low, interval.high], [place, place], color=GRAY, linewidth=6)
        axes.plot(interval.estimate, place, "o", color=SERIES_COLORS[0], clip_on=False)
        axes.text(-0.02, place, label, ha="right", va="center", fontsize=8, color=INK)
    axes.axvline(0.5, color=GRAY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.set(xlim=(0, 1), ylim=(-0.6, len(pairs) - 0.4), yticks=[])
    axes.set_xlabel("probability of improvement", fontsize=9, color=INK)
    axes.spines[["left", "top", "right"]].set_visible(False)
    return figure


def write_figures(results: Sequence[Result], folder: Path, mode: str = STOCHASTIC) -> None:
    """Write ``curves.png`` and, for more than one name, ``improvement.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    curves_figure(results, mode).savefig(folder / "curves.png")
    if len(distinct(results, "name")) > 1:
        improvement_figure(results, mode).savefig(folder / "improvement.png")


def main(argv: list[str]) -> int:
    """Draw what a folder has."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.benchmark plot", description=__doc__
    )
    parser.add_argument("folder", type=Path, nargs="?", default=DEFAULT_FOLDER)
    parser.add_argument("--out", type=Path, help="a folder; that of the results if not given")
    parser.add_argument(
        "--mode", choices=(STOCHASTIC, LATENT_ONLY, DETERMINISTIC), default=STOCHASTIC
    )
    arguments = parser.parse_args(argv)
    results = load_results(arguments.folder)
    write_figures(results, arguments.out or arguments.folder, arguments.mode)
    return 0
