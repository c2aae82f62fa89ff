"""Short clonings of small models, for the tests of this folder."""

from typing import Any

import numpy as np

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import SMALL, TINY

ALGORITHMS = [PolicyFlow, FPO, DPPO]
SHORT: dict[str, Any] = {"gradient_steps": 40, "batch_size": 32, "eval_freq": 10}


def shown(n: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions of a pendulum, as many as wanted."""
    rng = np.random.default_rng(0)
    observations = rng.standard_normal((n, 3)).astype(np.float32)
    return observations, np.tanh(observations[:, :1])


def pendulum(algorithm: type[Any], **options: Any) -> Any:
    """A small model of it."""
    policy_kwargs = {**TINY, **options.pop("policy_kwargs", {})}
    return algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, **SMALL | options)
