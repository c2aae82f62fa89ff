"""The statistics are rliable's."""

import numpy as np
import pytest

from sb3_policyflow.benchmark.statistics import (
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
    score_matrix,
)

metrics = pytest.importorskip("rliable.metrics")
library = pytest.importorskip("rliable.library")


@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (5, 2), (10, 7)])
def test_interquartile_mean(shape: tuple[int, int]) -> None:
    scores = np.random.default_rng(0).normal(size=shape)
    assert interquartile_mean(scores) == pytest.approx(metrics.aggregate_iqm(scores))


@pytest.mark.parametrize("shapes", [((5, 3), (5, 3)), ((4, 2), (7, 2))])
def test_probability_of_improvement(shapes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    generator = np.random.default_rng(1)
    # Whole numbers, so that there are ties.
    one, other = (generator.integers(0, 5, shape).astype(float) for shape in shapes)
    expected = metrics.probability_of_improvement(one, other)
    assert probability_of_improvement(one, other) == pytest.approx(expected)


def test_interval() -> None:
    scores = np.random.default_rng(2).normal(size=(10, 4))
    estimate, low, high = bootstrap_interval(interquartile_mean, scores, n_resamples=5000)
    estimates, intervals = library.get_interval_estimates(
        {"ours": scores}, lambda s: np.array([metrics.aggregate_iqm(s)]), reps=5000
    )
    assert estimate == pytest.approx(estimates["ours"][0])
    np.testing.assert_allclose([low, high], intervals["ours"][:, 0], atol=0.03)


def test_interval_of_two_arrays_is_repeatable() -> None:
    one, other = np.random.default_rng(3).normal(size=(2, 6, 3))
    first = bootstrap_interval(probability_of_improvement, one, other, n_resamples=200)
    assert first == bootstrap_interval(probability_of_improvement, one, other, n_resamples=200)
    assert first.low < first.estimate < first.high


def test_scores_of_tasks() -> None:
    np.testing.assert_array_equal(score_matrix([[1, 2, 3], [4, 5, 6]])[:, 1], [4, 5, 6])
    with pytest.raises(ValueError, match="the same number of seeds"):
        score_matrix([[1, 2], [3]])
