"""Where in the maze a training goes: visit counts, two numbers and the density map.

The paper shows maps of all training episodes; here they come with the share of the free space that
was visited, and the entropy of the visits relative to a uniform density. Both are over square cells
of side ``CELL_SIZE``, of which each free cell of the maze has 16; the ball's center can reach all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from sb3_policyflow.benchmark.goals import normalized_entropy
from sb3_policyflow.benchmark.plots import DPI
from sb3_policyflow.envs.drawing import GOAL_COLORS, INK, MARGIN
from sb3_policyflow.envs.point_maze import GOAL_CELLS, START_CELL, cell_center, medium_maze

FloatArray = NDArray[np.float64]

CELLS_PER_SIDE = 4
CELL_SIZE = 1.0 / CELLS_PER_SIDE
SCALE_LIMITS = (0.01, 100.0)
SCALE = LogNorm(*SCALE_LIMITS)
COLORS = colormaps["YlGnBu"].with_extremes(bad=MARGIN, under="white")


@dataclass(frozen=True)
class VisitMap:
    """Environment steps that ended in each cell.

    :param counts: visits, rows from the top, shape ``(n_rows, n_columns)``
    :param free: whether each cell is free of walls, of the same shape
    """

    counts: NDArray[np.int64]
    free: NDArray[np.bool_]

    @property
    def coverage(self) -> float:
        """Share of the free cells that were visited at least once."""
        return float((self.counts[self.free] > 0).mean())

    @property
    def entropy(self) -> float:
        """Entropy of the visits over the free cells, relative to that of a uniform density."""
        return normalized_entropy(self.counts[self.free])

    @property
    def density(self) -> FloatArray:
        """Visits relative to a uniform density (1 everywhere), NaN in walls."""
        n_visits = max(1, self.counts[self.free].sum())
        return np.where(self.free, self.counts * self.free.sum() / n_visits, np.nan)

    def save(self, path: str | Path) -> None:
        """Write to an ``npz`` file."""
        np.savez_compressed(path, counts=self.counts, free=self.free)

    @classmethod
    def load(cls, path: str | Path) -> VisitMap:
        """Read what ``save`` wrote."""
        with np.load(path) as file:
            return cls(file["counts"], file["free"])


class VisitCounter(BaseCallback):
    """Counts, at each environment step of a training, the cells that the balls are in.

    Episodes' last positions count, their given starts do not: the total is the number of steps.
    Observations may be those of ``PointMazeMultiGoal-Medium-v0`` or of the stock medium mazes,
    under ``VecNormalize`` or not.
    """

    def __init__(self) -> None:
        super().__init__()
        self.free = np.kron(medium_maze(), np.ones((CELLS_PER_SIDE, CELLS_PER_SIDE), dtype=bool))
        self.counts = np.zeros(self.free.shape, dtype=np.int64)

    def visits(self) -> VisitMap:
        """The counts so far; a copy."""
        return VisitMap(self.counts.copy(), self.free)

    def _on_step(self) -> bool:
        self._count(self._last_positions())
        return True

    def _last_positions(self) -> FloatArray:
        """Where the step ended, before any reset, shape ``(num_envs, 2)``."""
        normalizer = self.model.get_vec_normalize_env()
        raw = normalizer.get_original_obs() if normalizer else self.locals["new_obs"]
        positions = _positions(raw).copy()
        for i in np.flatnonzero(self.locals["dones"]):
            last = self.locals["infos"][i]["terminal_observation"]
            positions[i] = _positions(normalizer.unnormalize_obs(last) if normalizer else last)
        return positions

    def _count(self, positions: FloatArray) -> None:
        n_rows, n_columns = self.free.shape
        columns = np.floor(positions[:, 0] / CELL_SIZE + n_columns / 2).astype(int)
        rows = np.floor(n_rows / 2 - positions[:, 1] / CELL_SIZE).astype(int)
        cells = rows.clip(0, n_rows - 1) * n_columns + columns.clip(0, n_columns - 1)
        self.counts += np.bincount(cells, minlength=self.free.size).reshape(self.free.shape)


def _positions(observations: Any) -> FloatArray:
    kinematic = observations["observation"] if isinstance(observations, dict) else observations
    return np.asarray(kinematic, dtype=np.float64)[..., :2]


def density_figure(runs: Mapping[str, VisitMap | Sequence[VisitMap]]) -> Figure:
    """The maze for each run, colored by visits on one common scale, with the two numbers below.

    Several maps of one name are its seeds: their mean density, and the means of their numbers.

    :param runs: visit maps by the panel's title
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
    bar.set_label("visits relative to uniform", fontsize=8, color=INK)
    bar.ax.tick_params(which="both", labelsize=7, labelcolor=INK, length=0)
    bar.outline.set_visible(False)
    return figure


def _draw_density(axes: Axes, density: FloatArray) -> None:
    """Walls gray, unvisited cells white; what is off the scale gets its nearest color."""
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
