"""Maps of where in the maze trainings go."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sb3_policyflow.benchmark.figures.style import DPI
from sb3_policyflow.benchmark.measure.visits import CELL_SIZE, VisitMap
from sb3_policyflow.envs.drawing import GOAL_COLORS, INK, MARGIN
from sb3_policyflow.envs.point_maze import GOAL_CELLS, START_CELL, cell_center, medium_maze

SCALE_LIMITS = (0.01, 100.0)
SCALE = LogNorm(*SCALE_LIMITS)
COLORS = colormaps["YlGnBu"].with_extremes(bad=MARGIN, under="#F2B8A0")


def density_figure(runs: Mapping[str, VisitMap | Sequence[VisitMap]]) -> Figure:
    """The maze for each run, colored by visits on one common scale, with the two numbers below.

    Several maps of one name are its seeds: their mean density, and the means of their numbers.

    :param runs: Visit maps by the panel's title.
    """
    figure = Figure(figsize=(2.7 * len(runs) + 0.8, 3.2), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(runs), squeeze=False)[0]
    for axes, (title, seeds) in zip(panels, runs.items(), strict=True):
        maps = [seeds] if isinstance(seeds, VisitMap) else list(seeds)
        _draw_density(axes, np.mean([each.density for each in maps], axis=0))
        coverage = np.mean([each.coverage for each in maps])
        entropy = np.mean([each.entropy for each in maps])
        label = f"visited {coverage:.1%}   entropy {entropy:.2f}"
        axes.set_title(title, fontsize=10, color=INK)
        axes.set_xlabel(label, fontsize=8, color=INK)
    bar = figure.colorbar(ScalarMappable(SCALE, COLORS), ax=panels, shrink=0.75, aspect=24)
    bar.set_label("visits relative to uniform (red: none)", fontsize=8, color=INK)
    bar.ax.tick_params(which="both", labelsize=7, labelcolor=INK, length=0)
    bar.outline.set_visible(False)
    return figure


def _draw_density(axes: Axes, density: NDArray[np.float64]) -> None:
    """Walls gray, unvisited cells red; what is off the scale gets its nearest color."""
    visited = density.clip(*SCALE_LIMITS)
    shown = np.where(density > 0, visited, np.where(np.isnan(density), np.nan, 1e-9))
    half = len(density) * CELL_SIZE / 2
    axes.imshow(shown, COLORS, SCALE, extent=(-half, half, -half, half), interpolation="nearest")
    _draw_marks(axes)
    inside = half - 0.75
    axes.set(xlim=(-inside, inside), ylim=(-inside, inside), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _draw_marks(axes: Axes) -> None:
    maze = medium_maze()
    goals = np.array([cell_center(cell, maze) for cell in GOAL_CELLS])
    start = cell_center(START_CELL, maze)
    for points, color in ((goals, GOAL_COLORS[4]), (start[None], GOAL_COLORS[2])):
        axes.scatter(
            points[:, 0], points[:, 1], s=52, color=color, edgecolors="white", linewidths=1.3
        )
