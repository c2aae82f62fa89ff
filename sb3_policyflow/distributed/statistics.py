"""The running statistics of ``VecNormalize``, merged from what each rank has seen."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


def running_statistics(normalize: VecNormalize | None) -> list[RunningMeanStd]:
    """What the wrapper keeps, in the same order on every rank.

    :param normalize: The environment's wrapper, if it has one.
    """
    if normalize is None:
        return []
    of_observations: Any = getattr(normalize, "obs_rms", [])
    if isinstance(of_observations, dict):
        of_observations = [of_observations[key] for key in sorted(of_observations)]
    elif isinstance(of_observations, RunningMeanStd):
        of_observations = [of_observations]
    return [*of_observations, normalize.ret_rms]


class MergedStatistics:
    """Running statistics that count what all ranks have seen, each number once.

    A rank's share is what it has seen since the last merge. The moments of the shares are taken
    about the mean of the last merge, so that they add up without cancellation:

    n = n0 + sum dn,    m = m0 + sum d1 / n,    n var = n0 var0 + sum d2 - n (m - m0)^2

    with d1 = n_r (m_r - m0) and d2 = n_r (var_r + (m_r - m0)^2) - n0 var0 of rank r.

    :param statistics: This rank's, which are changed in place. They must be those of the other
        ranks now.
    :param add: Sums float64 tensors over the ranks.
    """

    def __init__(
        self, statistics: list[RunningMeanStd], add: Callable[[th.Tensor], th.Tensor]
    ) -> None:
        self._statistics = statistics
        self._add = add
        self._merged = [each.copy() for each in statistics]

    def merge(self) -> None:
        """Replace the statistics by those of all that was seen on any rank; all ranks do so."""
        if not self._statistics:
            return
        shares = [_share(*pair) for pair in zip(self._statistics, self._merged, strict=True)]
        total = self._add(th.from_numpy(np.concatenate(shares))).numpy()
        parts = np.split(total, np.cumsum([len(share) for share in shares])[:-1])
        for own, before, part in zip(self._statistics, self._merged, parts, strict=True):
            own.mean, own.var, own.count = _union(before, part)
        self._merged = [each.copy() for each in self._statistics]


def _share(now: RunningMeanStd, before: RunningMeanStd) -> np.ndarray:
    """dn, d1 and d2, one after another."""
    shift = now.mean - before.mean
    squares = now.count * (now.var + shift**2) - before.count * before.var
    moments = np.ravel(now.count * shift), np.ravel(squares)
    return np.concatenate([[now.count - before.count], *moments])


def _union(before: RunningMeanStd, share: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean, variance and number after adding a share."""
    first, second = np.split(share[1:], 2)
    count = before.count + float(share[0])
    shift = (first / count).reshape(before.mean.shape)
    squares = before.count * before.var + second.reshape(before.var.shape)
    return before.mean + shift, squares / count - shift**2, count
