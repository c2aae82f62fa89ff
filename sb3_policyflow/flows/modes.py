"""The mode of a flow's end points, estimated from a few of them."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch as th
from numpy.typing import NDArray

N_CANDIDATES = 16
"""How many latents the deterministic action is chosen from. Of twice as many, the chosen one lies
in a likely place 1 to 6 percent more often (``tests/scripts/candidates.py``)."""
BANDWIDTH = 0.5
"""Bandwidth of the density estimate in units of Scott's rule, which is for a single mode."""
FIRST = 1.5
"""How much denser others must be than the first point. It is where the latent 0 ends, and where
there is one mode, the noise of the estimate would choose another one beside it."""


def densest(points: th.Tensor) -> th.Tensor:
    """The point of a sample around which the others lie most densely: an estimate of the mode.

    argmax_i sum_j exp(-||x_i - x_j||^2 / (2 h^2)),    h = 1/2 k^(-1 / (d + 4)) s sqrt(d)

    A kernel density estimate over k points in d dimensions, whose mean variance is s^2. With two
    clusters it is a point of one of them, where their mean, and their medoid, lie between.

    >>> densest(th.tensor([[[0.0], [1.0], [-1.1], [-0.9], [-1.0]]]))
    tensor([4])

    :param points: Shape (n, k, d).
    :return: Indices, shape (n,); the first, unless another is :data:`FIRST` times as dense.
    """
    k, d = points.shape[1:]
    # Distances of points that lie close together, but far from zero, would be lost in rounding.
    points = points - points.mean(dim=1, keepdim=True)
    squares = points.square().sum(-1)
    products = points @ points.transpose(1, 2)
    distances = squares.unsqueeze(1) + squares.unsqueeze(2) - 2 * products
    scale = squares.mean(-1) * relative_bandwidth(k, d)
    scale = scale.clamp_min(th.finfo(points.dtype).tiny)
    densities = (-distances / scale[:, None, None]).exp().sum(-1)
    return th.cat([FIRST * densities[:, :1], densities[:, 1:]], dim=1).argmax(-1)


def relative_bandwidth(n_points: int, dim: int) -> float:
    """2 h^2 of :func:`densest`, divided by the mean square of the distances from the mean."""
    return 2 * BANDWIDTH**2 * float(n_points ** (-2 / (dim + 4)))


def densest_endpoints(
    transport: Callable[[th.Tensor, th.Tensor], th.Tensor],
    latents: th.Tensor,
    features: th.Tensor,
) -> tuple[th.Tensor, th.Tensor]:
    """For each observation, the latent whose end point has the most others around it.

    :param transport: The flow, a function of latents (n k, d) and features (n k, features_dim).
    :param latents: The same k latents for all observations, shape (k, d).
    :param features: Features of n observations, shape (n, features_dim).
    :return: The latents and their end points, each of shape (n, d).
    """
    n, k = features.shape[0], latents.shape[0]
    # Contiguous, as kernels take it: of one observation it would be a view.
    repeated = features.unsqueeze(1).expand(-1, k, -1).flatten(0, 1).contiguous()
    endpoints = transport(latents.repeat(n, 1), repeated).reshape(n, k, latents.shape[1])
    chosen = densest(endpoints)
    rows = th.arange(n, device=chosen.device)
    return latents[chosen], endpoints[rows, chosen]


def candidate_latents(dim: int, scale: float = 1.0) -> th.Tensor:
    """Fixed latents to choose the deterministic action from: 0, and draws from N(0, scale^2 I).

    :param dim: Dimensions of the action.
    :param scale: Standard deviation of the latents.
    :return: Shape (N_CANDIDATES, dim), float32 on the CPU; the same in every process.
    """
    # What is cached is no tensor: one that is made while a policy is exported has no values.
    return th.from_numpy(_candidates(dim, scale))


@lru_cache
def _candidates(dim: int, scale: float) -> NDArray[np.float32]:
    # This generator's numbers will not change in later versions of NumPy.
    draws = np.random.RandomState(0).standard_normal((N_CANDIDATES, dim))
    draws[0] = 0.0
    return draws.astype(np.float32) * np.float32(scale)
