"""Aggregates over seeds with their uncertainty (Agarwal et al., 2021, arXiv 2108.13264).

The same figures as the package rliable's, in numpy. Scores are arrays (n_seeds, n_tasks).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Scores = NDArray[np.float64]


class Interval(NamedTuple):
    """An estimate and the ends of its confidence interval; NaN if there is only one seed."""

    estimate: float
    low: float
    high: float


def interquartile_mean(scores: Scores) -> float:
    """Mean of the middle half of all scores.

    >>> interquartile_mean(np.array([[0.0], [2.0], [4.0], [100.0]]))
    3.0
    """
    ordered = np.sort(scores, axis=None)
    n_cut = len(ordered) // 4
    return float(ordered[n_cut : len(ordered) - n_cut].mean())


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """Probability that a score is greater than another one of the same task, averaged over tasks.

    A tie counts half.

    >>> probability_of_improvement(np.array([[1.0], [3.0]]), np.array([[1.0], [2.0]]))
    0.625
    """
    ours, theirs = scores[:, None], others[None]
    return float(((ours > theirs) + 0.5 * (ours == theirs)).mean())


def bootstrap_interval(
    statistic: Callable[..., float],
    *scores: Scores,
    n_resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Interval:
    """A statistic with its percentile bootstrap interval, resampled within each task.

    If there is only one seed of everything, there is nothing to resample, and no interval.

    :param statistic: A function of one or more arrays of scores.
    :param scores: What it is taken of.
    :param n_resamples: Resamples.
    :param confidence: Share of the resamples between the interval's ends.
    :param seed: Of the resamples.
    """
    if all(len(array) == 1 for array in scores):
        return Interval(statistic(*scores), math.nan, math.nan)
    generator = np.random.default_rng(seed)
    values = [
        statistic(*(_resample(array, generator) for array in scores)) for _ in range(n_resamples)
    ]
    tail = (1 - confidence) / 2
    low, high = np.quantile(values, [tail, 1 - tail])
    return Interval(statistic(*scores), float(low), float(high))


def _resample(scores: Scores, generator: np.random.Generator) -> Scores:
    """Seeds drawn with replacement, anew for each task."""
    rows = generator.integers(len(scores), size=scores.shape)
    return np.take_along_axis(scores, rows, axis=0)


def score_matrix(scores: Sequence[Sequence[float]]) -> Scores:
    """The scores of the tasks, each with its seeds, as an array (n_seeds, n_tasks).

    :raises ValueError: If not all tasks have the same number of seeds.
    """
    lengths = {len(task) for task in scores}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(f"All tasks need the same number of seeds, got {sorted(lengths)}.")
    return np.array(scores, dtype=np.float64).T
