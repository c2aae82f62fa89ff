"""Settings for all tests: a run is repeatable, and small tensors need one thread."""

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_policyflow import DPPO, FPO, PolicyFlow

th.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    th.manual_seed(0)
    np.random.seed(0)


@pytest.fixture(params=[PolicyFlow, FPO, DPPO], ids=lambda algorithm: str(algorithm.__name__))
def algorithm(request: pytest.FixtureRequest) -> type[Any]:
    """Each of the algorithms in turn."""
    chosen: type[Any] = request.param
    return chosen
