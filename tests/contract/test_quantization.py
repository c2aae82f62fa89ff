"""A policy whose linear layers are quantized acts nearly as before."""

from typing import Any

import numpy as np
import pytest
import torch as th

from tests.helpers import perturb

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_a_dynamically_quantized_policy_acts_nearly_as_before(algorithm: Any) -> None:
    policy = algorithm("MlpPolicy", "Pendulum-v1", device="cpu").policy
    perturb(policy, 0.05)
    policy.set_training_mode(False)
    small = th.ao.quantization.quantize_dynamic(policy, {th.nn.Linear}, dtype=th.qint8)
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    actions, _ = policy.predict(observations, deterministic=True)
    found, _ = small.predict(observations, deterministic=True)
    assert np.abs(found - actions).max() < 0.05 * 4  # of an action space that is 4 wide
    assert np.ptp(actions) > 0.1
    small.predict(observations[0])
    with th.no_grad():
        assert small(th.as_tensor(observations))[1].shape == (20, 1)
