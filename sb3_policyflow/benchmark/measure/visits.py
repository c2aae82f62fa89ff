"""Where in the maze a training goes: visit counts, and two numbers.

The paper shows maps of all training episodes; here they come with the share of the free space that
was visited, and the entropy of the visits relative to a uniform density. Both are over square cells
of side ``CELL_SIZE``, of which each free cell of the maze has 16; the ball's center can reach all.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from sb3_policyflow.benchmark.measure.entropy import normalized_entropy
from sb3_policyflow.envs.point_maze import medium_maze

CELLS_PER_SIDE = 4
CELL_SIZE = 1.0 / CELLS_PER_SIDE


@dataclass(frozen=True)
class VisitMap:
    """Environment steps that ended in each cell.

    :param counts: Visits, rows from the top, shape ``(n_rows, n_columns)``.
    :param free: Whether each cell is free of walls, of the same shape.
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
    def density(self) -> NDArray[np.float64]:
        """Visits relative to a uniform density (1 everywhere), NaN in walls."""
        n_visits = max(1, self.counts[self.free].sum())
        return np.where(self.free, self.counts * self.free.sum() / n_visits, np.nan)

    def save(self, path: str | Path) -> None:
        """Write to an ``npz`` file."""
        np.savez_compressed(path, counts=self.counts, free=self.free)

    @classmethod
    def load(cls, path: str | Path) -> "VisitMap":
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

    def _last_positions(self) -> NDArray[np.float64]:
        """Where the step ended, before any reset, shape ``(num_envs, 2)``."""
        normalizer = self.model.get_vec_normalize_env()
        raw = normalizer.get_original_obs() if normalizer else self.locals["new_obs"]
        positions = _positions(raw).copy()
        for i in np.flatnonzero(self.locals["dones"]):
            last = self.locals["infos"][i]["terminal_observation"]
            positions[i] = _positions(normalizer.unnormalize_obs(last) if normalizer else last)
        return positions

    def _count(self, positions: NDArray[np.float64]) -> None:
        n_rows, n_columns = self.free.shape
        columns = np.floor(positions[:, 0] / CELL_SIZE + n_columns / 2).astype(int)
        rows = np.floor(n_rows / 2 - positions[:, 1] / CELL_SIZE).astype(int)
        cells = rows.clip(0, n_rows - 1) * n_columns + columns.clip(0, n_columns - 1)
        self.counts += np.bincount(cells, minlength=self.free.size).reshape(self.free.shape)


def _positions(observations: Any) -> NDArray[np.float64]:
    kinematic = observations["observation"] if isinstance(observations, dict) else observations
    return np.asarray(kinematic, dtype=np.float64)[..., :2]
