"""How many candidates the deterministic action needs, on flows whose modes are known.

python tests/scripts/candidates.py

A flow of this study carries a latent to a mean of modes, weighted by a softmax over random
directions of the latent, which is nearly always one of them, plus a tenth or three tenths of the
latent. Prints in what share of 300 such flows the chosen end point lies where the density of the
end points is at least that of the least dense quarter of all draws.
"""

import sys

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_policyflow.flows.modes import densest

Array = NDArray[np.float64]
N_FLOWS, N_DRAWS, SHARPNESS = 300, 2000, 8.0
N_CANDIDATES = (8, 16, 32, 64)


def random_flow(rng: np.random.Generator, dim: int, n_modes: int, spread: float) -> Array:
    """End points of 64 candidates, of which the first is that of the latent 0, and of draws."""
    modes, directions = rng.standard_normal((2, n_modes, dim))
    offsets = 0.5 * rng.standard_normal(n_modes)
    latents = rng.standard_normal((max(N_CANDIDATES) + N_DRAWS, dim))
    latents[0] = 0.0
    scores = SHARPNESS * (latents @ directions.T / np.sqrt(dim) + offsets)
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    ends: Array = weights / weights.sum(axis=1, keepdims=True) @ modes + spread * latents
    return ends


def density(points: Array, draws: Array, width: float) -> Array:
    """A kernel density estimate without its constant, shape (n,)."""
    squares = ((points[:, None] - draws) ** 2).sum(axis=-1)
    result: Array = np.exp(-squares / (2 * width**2)).sum(axis=1)
    return result


def main() -> None:
    """Print a table."""
    rng = np.random.default_rng(0)
    sys.stdout.write(f"dim modes spread  zero {N_CANDIDATES}\n")
    for dim in (1, 2, 6):
        for n_modes in (2, 3, 6):
            for spread in (0.1, 0.3):
                found = np.zeros(1 + len(N_CANDIDATES))
                for _ in range(N_FLOWS):
                    ends = random_flow(rng, dim, n_modes, spread)
                    draws = ends[max(N_CANDIDATES) :]
                    width = spread * np.sqrt(dim) / 2
                    least = np.quantile(density(draws[:100], draws, width), 0.25)
                    candidates = [th.from_numpy(ends[None, :n]) for n in N_CANDIDATES]
                    chosen = [0, *(int(densest(points)) for points in candidates)]
                    found += density(ends[chosen], draws, width) >= least
                shares = " ".join(f"{share:.2f}" for share in found / N_FLOWS)
                sys.stdout.write(f"{dim:3} {n_modes:5} {spread:6}  {shares}\n")


if __name__ == "__main__":
    main()
