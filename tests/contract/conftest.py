"""What is asked of our algorithms is asked of SB3's PPO too, which is the oracle."""

from typing import Any

import pytest
from stable_baselines3 import PPO

from sb3_policyflow import DPPO, FPO, PolicyFlow


@pytest.fixture(params=[PPO, PolicyFlow, FPO, DPPO], ids=lambda algorithm: str(algorithm.__name__))
def any_algorithm(request: pytest.FixtureRequest) -> type[Any]:
    """PPO, and each of the algorithms in turn."""
    chosen: type[Any] = request.param
    return chosen
