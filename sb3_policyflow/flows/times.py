"""Times at which velocities are compared (paper, sensitivity to the time sampling strategy)."""

from typing import Protocol

import torch as th


class TimeSampler(Protocol):
    """Draws the times at which velocities are compared."""

    def sample(self, n_samples: int, n_times: int) -> th.Tensor:
        """Times of shape (n_samples, n_times)."""


class GridTimes:
    """Times drawn uniformly from a grid (paper: USD, and Multi-USD for several times).

    >>> times = GridTimes(th.tensor([0.0, 0.5, 1.0])).sample(100, 2)
    >>> times.shape, sorted(set(times.flatten().tolist()))
    (torch.Size([100, 2]), [0.0, 0.5, 1.0])

    :param grid: The times to draw from, shape (n,).
    """

    def __init__(self, grid: th.Tensor) -> None:
        self.grid = grid

    def sample(self, n_samples: int, n_times: int) -> th.Tensor:
        """Times of shape (n_samples, n_times), on the grid's device."""
        size = (n_samples, n_times)
        return self.grid[th.randint(len(self.grid), size, device=self.grid.device)]


class GridTimesWithoutEnd(GridTimes):
    """Times drawn uniformly from a grid without its end: for Euler, those at which steps start.

    >>> times = GridTimesWithoutEnd(th.tensor([0.0, 0.5, 1.0])).sample(100, 1)
    >>> sorted(set(times.flatten().tolist()))
    [0.0, 0.5]
    """

    def __init__(self, grid: th.Tensor) -> None:
        super().__init__(grid[:-1])


class UniformTimes:
    """Times drawn uniformly between the grid's ends (paper: USC).

    >>> bool((UniformTimes(th.tensor([0.0, 2.0])).sample(100, 1) <= 2.0).all())
    True

    :param grid: Times whose first and last are the ends, shape (n,).
    """

    def __init__(self, grid: th.Tensor) -> None:
        self.grid = grid

    def sample(self, n_samples: int, n_times: int) -> th.Tensor:
        """Times of shape (n_samples, n_times), on the grid's device and of its dtype."""
        start, end = self.grid[0], self.grid[-1]
        fractions = th.rand(n_samples, n_times, device=self.grid.device, dtype=self.grid.dtype)
        return start + (end - start) * fractions


TIME_SAMPLERS: dict[str, type[GridTimes | UniformTimes]] = {
    "grid": GridTimes,
    "grid_without_end": GridTimesWithoutEnd,
    "uniform": UniformTimes,
}
"""Time samplers by their names."""

StartTimes = GridTimesWithoutEnd
"""Deprecated alias of :class:`GridTimesWithoutEnd`."""
