"""Settings for all tests: a run is repeatable, and small tensors need one thread."""

import numpy as np
import pytest
import torch as th

th.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    th.manual_seed(0)
    np.random.seed(0)
