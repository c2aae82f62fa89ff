"""torch's default device and dtype are not the model's: a run does not depend on them."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.callbacks import FlowDiagnosticsCallback
from sb3_policyflow.export import ActionModule
from tests.helpers import SMALL, TINY, weights

SHARED: dict[str, Any] = {"clip_range_vf": 0.2, "ent_coef": 0.01, "desired_kl": 0.01}
DRAWN = {"deterministic_action": "drawn"}
RUNS: list[tuple[Any, dict[str, Any]]] = [
    (PolicyFlow, {}),
    (PolicyFlow, {**SHARED, "brownian_coef": 0.1, "uniform_noise_coef": 0.1, "n_times": 2}),
    (PolicyFlow, {"time_sampler": "uniform", "interpolant": "stochastic", "solver": "ab2"}),
    (PolicyFlow, {"interpolant": "trigflow", "timeout_bootstrap": "none"}),
    (FPO, {}),
    (FPO, {**SHARED, "trust_region": "aspo", "time_sampler": "uniform", "solver": "rk4"}),
    (FPO, {"trust_region": "spo", "action_noise_std": 0.1, "timeout_bootstrap": "current"}),
    (DPPO, {}),
    (DPPO, {**SHARED, "clip_range_base": 0.01, "n_denoising_steps": 4, "n_finetuned_steps": 3}),
    (
        DPPO,
        {"process": "flow", "noise_clip": None, "policy_kwargs": DRAWN},
    ),
]


@pytest.fixture(params=["meta", "float64"])
def other_default(request: pytest.FixtureRequest) -> Iterator[Any]:
    """A function that sets another default device or dtype until the test ends."""

    def change() -> None:
        if request.param == "meta":
            th.set_default_device("meta")
        else:
            th.set_default_dtype(th.float64)

    yield change
    th.set_default_device(None)
    th.set_default_dtype(th.float32)


def train(algorithm: Any, options: dict[str, Any], change: Any) -> tuple[Any, th.Tensor]:
    options = {"policy_kwargs": {}, **options}
    policy_kwargs = {**TINY, **options.pop("policy_kwargs"), "initialization": "glorot"}
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, **SMALL, **options)
    change()
    model.learn(2 * SMALL["n_steps"], callback=FlowDiagnosticsCallback())
    actions = model.predict(np.ones((3, 3), np.float32), deterministic=True)[0]
    return actions, weights(model)


@pytest.mark.parametrize(("algorithm", "options"), RUNS)
def test_defaults_set_after_a_model_was_made_change_no_bit_of_its_training(
    algorithm: Any, options: dict[str, Any], other_default: Any
) -> None:
    actions, expected = train(algorithm, options, lambda: None)
    other_actions, found = train(algorithm, options, other_default)
    assert found.device == expected.device
    assert th.equal(found, expected)
    assert np.array_equal(other_actions, actions)


@pytest.mark.parametrize(("algorithm", "options"), [RUNS[0], RUNS[1], RUNS[5], RUNS[8]])
def test_nor_without_kernels(
    algorithm: Any, options: dict[str, Any], other_default: Any, no_kernels: None
) -> None:
    _, expected = train(algorithm, options, lambda: None)
    assert th.equal(train(algorithm, options, other_default)[1], expected)


def test_an_exported_policy_has_the_policys_tensors(algorithm: Any, other_default: Any) -> None:
    policy = algorithm("MlpPolicy", "Pendulum-v1", device="cpu").policy
    other_default()
    module = ActionModule(policy)
    (observations,) = module.example()
    assert observations.device.type == "cpu"
    assert module(observations).dtype == th.float32
