"""Figures: MultiGoal trajectories and learning curves.

Each function returns a Matplotlib ``Figure`` made without ``pyplot``, so no global state changes;
``figure.savefig("name.png")`` writes it.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from sb3_policyflow.benchmark.goals import Trajectories, goal_report
from sb3_policyflow.envs.drawing import GOAL_COLORS, INK
from sb3_policyflow.envs.multigoal.point_masses import GOALS, WALL

FloatArray = NDArray[np.float64]

GRAY = "#9aa0a8"
PALE = "#d9dce1"
# Okabe and Ito's palette in the order in which it separates best on white.
SERIES_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MONITOR_WINDOW = 100
DPI = 160


def draw_trajectories(axes: Axes, trajectories: Trajectories) -> None:
    """Draw the workspace, its goals and each trajectory in the color of the goal it ended at."""
    reached = trajectories.goals()
    palette = np.array([*(to_rgba(color) for color in GOAL_COLORS), to_rgba(GRAY)])
    opacity = float(np.clip(60 / len(reached), 0.12, 0.8))
    for goal in range(-1, len(GOALS)):
        lines = trajectories.positions[reached == goal]
        axes.add_collection(
            LineCollection(
                list(lines),
                colors=[palette[goal]],
                linewidths=0.6,
                alpha=opacity,
                rasterized=True,
            )
        )
    _draw_workspace(axes)


def _draw_workspace(axes: Axes) -> None:
    wall = Rectangle((-WALL, -WALL), 2 * WALL, 2 * WALL, fill=False, edgecolor=PALE, linewidth=1.2)
    axes.add_patch(wall)
    axes.scatter(
        GOALS[:, 0], GOALS[:, 1], s=70, c=GOAL_COLORS, edgecolors="white", linewidths=1.4, zorder=3
    )
    axes.scatter(0, 0, s=16, color=INK, edgecolors="white", linewidths=0.8, zorder=3)
    axes.set(xlim=(-WALL - 0.3, WALL + 0.3), ylim=(-WALL - 0.3, WALL + 0.3), aspect="equal")
    axes.axis("off")


def draw_goal_counts(axes: Axes, trajectories: Trajectories) -> None:
    """Draw a bar for each goal's number of trajectories, in its color; dashed: all alike."""
    report = goal_report(trajectories)
    n = len(trajectories.lengths)
    places = range(len(GOALS))
    axes.bar(places, report.counts, color=GOAL_COLORS, width=0.72)
    axes.set_xticks(places, [str(count) for count in report.counts])
    axes.tick_params(length=0, labelsize=7.5, labelcolor=INK, pad=2)
    axes.axhline(n / len(GOALS), color=GRAY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.set(ylim=(0, 1.08 * max(n / len(GOALS), *report.counts)), yticks=[])
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.spines["bottom"].set_color(PALE)
    axes.set_xlabel(
        f"entropy {report.entropy:.2f}   return {report.mean_return:.1f}   "
        f"no goal {report.share_missed:.1%}",
        fontsize=8,
        color=INK,
    )


def goals_figure(runs: Mapping[str, Trajectories], n_columns: int = 3) -> Figure:
    """A panel for each run: its trajectories, and below them the counts, entropy and return.

    :param runs: trajectories by the panel's title
    :param n_columns: panels side by side
    """
    n_columns = min(n_columns, len(runs))
    n_rows = -(-len(runs) // n_columns)
    figure = Figure(figsize=(3.1 * n_columns, 4.05 * n_rows), dpi=DPI, layout="constrained")
    panels = np.ravel(figure.subfigures(n_rows, n_columns, squeeze=False))
    for panel, (title, trajectories) in zip(panels, runs.items(), strict=False):
        _draw_panel(panel, title, trajectories)
    return figure


def _draw_panel(panel: SubFigure, title: str, trajectories: Trajectories) -> None:
    upper, lower = panel.subplots(2, 1, height_ratios=[5, 1])
    draw_trajectories(upper, trajectories)
    draw_goal_counts(lower, trajectories)
    upper.set_title(title, fontsize=10, color=INK)


def learning_curve_figure(
    runs: Mapping[str, str | Path | Sequence[str | Path]], title: str = ""
) -> Figure:
    """Mean episode return over environment steps, one line a name.

    Several files of one name are its seeds: their mean, and a band from the lowest to the highest.

    :param runs: by name, SB3's ``progress.csv`` or a monitor file, or a list of them
    :param title: above the axes
    """
    figure = Figure(figsize=(5.6, 3.5), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    for i, (name, files) in enumerate(runs.items()):
        paths = [files] if isinstance(files, str | Path) else files
        curves = [read_learning_curve(path) for path in paths]
        _draw_curves(axes, name, curves, SERIES_COLORS[i % len(SERIES_COLORS)])
    style_curves(axes, title)
    if len(runs) > 1:
        axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    return figure


def _draw_curves(
    axes: Axes, name: str, curves: Sequence[tuple[FloatArray, FloatArray]], color: str
) -> None:
    end = min(steps[-1] for steps, _ in curves)
    start = max(steps[0] for steps, _ in curves)
    grid = np.linspace(start, end, 400)
    returns = np.stack([np.interp(grid, *curve) for curve in curves])
    axes.plot(grid, returns.mean(axis=0), color=color, linewidth=1.8, label=name)
    if len(curves) > 1:
        low, high = returns.min(axis=0), returns.max(axis=0)
        axes.fill_between(grid, low, high, color=color, alpha=0.18, linewidth=0)


def style_curves(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.set_xlabel("environment steps", fontsize=9, color=INK)
    axes.set_ylabel("mean episode return", fontsize=9, color=INK)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelsize=8, colors=INK, length=0)
    axes.grid(axis="y", color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.spines["bottom"].set_color(PALE)
    axes.margins(x=0.01)


def read_learning_curve(path: str | Path) -> tuple[FloatArray, FloatArray]:
    """Environment steps and mean episode returns out of a log file.

    :param path: SB3's ``progress.csv``, or a monitor file, whose returns are averaged over
        the last ``MONITOR_WINDOW`` episodes
    :raises ValueError: if the file is neither, or holds no finished episode
    """
    with open(path, newline="") as file:
        table = list(csv.DictReader(line for line in file if not line.startswith("#")))
    progress = [row for row in table if row.get("rollout/ep_rew_mean")]
    if progress:
        return _column(progress, "time/total_timesteps"), _column(progress, "rollout/ep_rew_mean")
    if table and {"r", "l"} <= set(table[0]):
        return _column(table, "l").cumsum(), _running_mean(_column(table, "r"))
    raise ValueError(
        f"{path} is neither SB3's progress.csv nor a monitor file, or has no finished episode yet."
    )


def _column(rows: Sequence[Mapping[str, str]], name: str) -> FloatArray:
    return np.array([float(row[name]) for row in rows])


def _running_mean(values: FloatArray) -> FloatArray:
    """Mean of the last ``MONITOR_WINDOW`` values, of fewer at the beginning."""
    totals = np.concatenate([[0.0], values.cumsum()])
    stops = np.arange(1, len(totals))
    starts = (stops - MONITOR_WINDOW).clip(0)
    means: FloatArray = (totals[stops] - totals[starts]) / (stops - starts)
    return means
