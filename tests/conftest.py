"""Settings for all tests: a run is repeatable, and small tensors need one thread."""

import sys
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common import utils

from sb3_policyflow import DPPO, FPO, PolicyFlow

th.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    th.manual_seed(0)
    np.random.seed(0)
    # torch.export turns the checks of distributions off, for the rest of the process.
    th.distributions.Distribution.set_default_validate_args(True)


@pytest.fixture(autouse=True)
def _on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The device "auto" is the CPU on machines with a GPU too; tests of the GPU name it."""

    def get_device(device: th.device | str = "auto") -> th.device:
        return utils.get_device("cpu" if device == "auto" else device)

    users = [
        module for name, module in sys.modules.items() if name.startswith("stable_baselines3.")
    ]
    for module in users if th.cuda.is_available() else []:
        if hasattr(module, "get_device") and module is not utils:
            monkeypatch.setattr(module, "get_device", get_device)


@pytest.fixture(params=[PolicyFlow, FPO, DPPO], ids=lambda algorithm: str(algorithm.__name__))
def algorithm(request: pytest.FixtureRequest) -> type[Any]:
    """Each of the algorithms in turn."""
    chosen: type[Any] = request.param
    return chosen
