"""Few seeds are shown as they are; statistics of more are rliable's."""

import numpy as np
import pytest

pytest.importorskip("rliable")

from rliable import library, metrics

from sb3_policyflow.benchmark.report.statistics import (
    interquartile_mean,
    over_seeds,
    score_matrix,
    share_of_pairs,
    stratified_bootstrap,
)


@pytest.mark.parametrize(
    ("scores", "text"),
    [([2.0], "2"), ([1.0, 3.0, 8.0], "4 (1 to 8)"), ([0.0, 0.0, 0.0, 8.0], "2 (0 to 8)")],
)
def test_fewer_than_five_seeds_have_a_mean_and_no_interval(scores: list[float], text: str) -> None:
    assert over_seeds(scores).format() == text


def test_five_seeds_have_an_interquartile_mean_and_an_interval() -> None:
    scores = [0.0, 1.0, 2.0, 3.0, 100.0]
    estimate = over_seeds(scores)
    assert estimate.value == 2.0
    assert 0 < estimate.low < 2 < estimate.high < 100
    assert estimate.format() == f"2 [{float(estimate.low):.4g}, {float(estimate.high):.4g}]"


def test_curves_are_estimated_at_each_of_their_points() -> None:
    curves = np.random.default_rng(0).normal(size=(6, 3))
    few, many = over_seeds(curves[:3]), over_seeds(curves)
    np.testing.assert_allclose(few.low, curves[:3].min(axis=0))
    np.testing.assert_allclose(many.value[1], metrics.aggregate_iqm(curves[:, [1]]))
    assert many.low.shape == (3,)


@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (5, 2), (10, 7)])
def test_interquartile_mean(shape: tuple[int, int]) -> None:
    scores = np.random.default_rng(0).normal(size=shape)
    assert interquartile_mean(scores) == pytest.approx(metrics.aggregate_iqm(scores))


@pytest.mark.parametrize("shapes", [((5, 3), (5, 3)), ((4, 2), (7, 2))])
def test_share_of_pairs(shapes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    generator = np.random.default_rng(1)
    # Whole numbers, so that there are ties.
    one, other = (generator.integers(0, 5, shape).astype(float) for shape in shapes)
    expected = metrics.probability_of_improvement(one, other)
    assert share_of_pairs(one, other) == pytest.approx(expected)


def test_interval_is_rliables() -> None:
    scores = np.random.default_rng(2).normal(size=(10, 4))
    estimate = stratified_bootstrap(interquartile_mean, scores)
    estimates, intervals = library.get_interval_estimates(
        {"ours": scores}, lambda s: np.array([metrics.aggregate_iqm(s)]), reps=5000
    )
    assert estimate.value == pytest.approx(estimates["ours"][0])
    np.testing.assert_allclose([estimate.low, estimate.high], intervals["ours"][:, 0], atol=0.03)


def test_interval_of_two_arrays_is_repeatable_and_leaves_the_generators_alone() -> None:
    one, other = np.random.default_rng(3).normal(size=(2, 6, 3))
    first = stratified_bootstrap(share_of_pairs, one, other)
    state = np.random.get_state()[1].copy()  # type: ignore[index,union-attr]
    assert first == stratified_bootstrap(share_of_pairs, one, other)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # type: ignore[index]
    assert first.low < first.value < first.high


def test_scores_of_tasks() -> None:
    np.testing.assert_array_equal(score_matrix([[1, 2, 3], [4, 5, 6]])[:, 1], [4, 5, 6])
    with pytest.raises(ValueError, match="the same number of seeds"):
        score_matrix([[1, 2], [3]])
