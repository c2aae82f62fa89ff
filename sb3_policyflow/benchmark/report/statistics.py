"""What some seeds say of an algorithm, and with what certainty.

From five seeds on this is the interquartile mean with its 95 % interval, from the percentile
bootstrap that is stratified by task (Agarwal et al., 2021, arXiv 2108.13264; computed by their
package rliable). Fewer seeds carry no such interval (of three seeds, it is their minimum and
maximum), so that the mean, minimum and maximum are given as what they are.

Scores are arrays of shape (n_seeds, n_tasks, ...).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_policyflow.benchmark.measure.seeding import seeded

Scores = NDArray[np.float64]

MIN_SEEDS = 5
"""From how many seeds on there are intervals."""

N_RESAMPLES = 10_000


class Estimate(NamedTuple):
    """A statistic, and the ends of a range around it, arrays of shape (...,).

    ``is_interval`` says that the range is a 95 % interval, and else that of minimum and maximum.
    """

    value: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    is_interval: bool

    def format(self, spec: str = ".4g") -> str:
        """An interval in brackets, or minimum and maximum in parentheses, unless all are alike.

        >>> Estimate(np.array(1.75), np.array(1.0), np.array(2.5), is_interval=False).format()
        '1.75 (1 to 2.5)'
        >>> Estimate(np.array(1.75), np.array(1.0), np.array(2.5), is_interval=True).format(".2f")
        '1.75 [1.00, 2.50]'
        """
        value, low, high = (format(float(number), spec) for number in self[:3])
        if self.is_interval:
            return f"{value} [{low}, {high}]"
        return value if self.low == self.high else f"{value} ({low} to {high})"


def over_seeds(scores: ArrayLike) -> Estimate:
    """What the seeds of one task say.

    :param scores: Numbers, or arrays of one shape, one for each seed, (n_seeds, ...).
    :return: The interquartile mean with its interval; of fewer than five seeds the mean with
        minimum and maximum.
    """
    array = np.asarray(scores, dtype=np.float64)
    if len(array) >= MIN_SEEDS:
        return stratified_bootstrap(interquartile_mean, array[:, None])
    return Estimate(array.mean(axis=0), array.min(axis=0), array.max(axis=0), is_interval=False)


def interquartile_mean(scores: Scores) -> NDArray[np.float64]:
    """Mean of the middle half of the scores of all seeds and tasks.

    >>> interquartile_mean(np.array([[0.0], [2.0], [4.0], [100.0]])).item()
    3.0

    :param scores: Shape (n_seeds, n_tasks, ...).
    :return: Shape (...,).
    """
    ordered = np.sort(scores.reshape(-1, *scores.shape[2:]), axis=0)
    n_cut = len(ordered) // 4
    mean: NDArray[np.float64] = ordered[n_cut : len(ordered) - n_cut].mean(axis=0)
    return mean


def share_of_pairs(scores: Scores, others: Scores) -> NDArray[np.float64]:
    """Share of the pairs of seeds, of all tasks, in which the first score is the greater one.

    A tie counts half. As an estimate this is rliable's probability of improvement, without the
    test of significance that makes it fifty times as slow.

    >>> share_of_pairs(np.array([[1.0], [3.0]]), np.array([[1.0], [2.0]])).item()
    0.625

    :param scores: Shape (n_seeds, n_tasks).
    :param others: Shape (n_other_seeds, n_tasks).
    """
    ours, theirs = scores[:, None], others[None]
    return np.asarray(((ours > theirs) + 0.5 * (ours == theirs)).mean())


def stratified_bootstrap(
    statistic: Callable[..., NDArray[np.float64]], *scores: Scores
) -> Estimate:
    """A statistic with its 95 % interval: seeds are resampled within each task.

    :param statistic: A function of one or more arrays of scores.
    :param scores: What it is taken of.
    """
    # Takes a second to import, and tables of fewer seeds can do without.
    from rliable.library import get_interval_estimates

    what = scores[0] if len(scores) == 1 else list(scores)
    with seeded(0):  # rliable draws from numpy's global generator
        values, intervals = get_interval_estimates(
            {"": what}, lambda *resampled: np.atleast_1d(statistic(*resampled)), reps=N_RESAMPLES
        )
    low, high = intervals[""]
    shape = np.shape(statistic(*scores))
    return Estimate(
        values[""].reshape(shape), low.reshape(shape), high.reshape(shape), is_interval=True
    )


def score_matrix(scores: Sequence[Sequence[float]]) -> Scores:
    """The scores of the tasks, each with its seeds, as an array (n_seeds, n_tasks).

    :raises ValueError: If not all tasks have the same number of seeds.
    """
    lengths = {len(task) for task in scores}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(f"All tasks need the same number of seeds, got {sorted(lengths)}.")
    return np.array(scores, dtype=np.float64).T
