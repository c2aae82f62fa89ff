import pytest
import torch as th

from sb3_policyflow.flows import GridTimes, UniformTimes
from sb3_policyflow.flows.solvers import solver_times


def test_grid_times_are_uniform_over_the_grid_with_its_ends() -> None:
    grid = solver_times("midpoint", 10)
    assert len(grid) == 21  # the paper's {0, 0.05, ..., 1}
    drawn = GridTimes(grid).sample(21_000, 2).flatten()
    counts = th.stack([(drawn == time).sum() for time in grid])
    assert counts.sum() == 42_000
    assert counts.min() > 1_700  # 2,000 expected: seven standard deviations
    assert counts.max() < 2_300


def test_uniform_times_fill_the_interval() -> None:
    drawn = UniformTimes(solver_times("euler", 3, end_time=2.0)).sample(10_000, 1)
    assert drawn.shape == (10_000, 1)
    assert drawn.min() >= 0.0
    assert drawn.max() <= 2.0
    assert drawn.mean().item() == pytest.approx(1.0, abs=0.03)
