"""Draws that are repeatable and leave no trace."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th

from sb3_policyflow.resilience.saving import preserve_rng_state


@contextmanager
def seeded(seed: int, device: th.device | str = "cpu") -> Iterator[None]:
    """Draw repeatably within the block, and go on after it as if nothing had been drawn.

    :param seed: Seed of torch's and numpy's generators.
    :param device: Where draws are made, whose generator is put back too.
    """
    with preserve_rng_state(th.device(device)):
        th.manual_seed(seed)
        np.random.seed(seed)
        yield
