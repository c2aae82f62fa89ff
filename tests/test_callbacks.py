"""The diagnostics tell the truth, and change nothing."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.callbacks import (
    FlowDiagnosticsCallback,
    end_point_shifts,
    warn_of_deterministic_actions,
)
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from tests.helpers import SMALL, TwoWays, weights

OPTIONS: dict[str, Any] = {
    **SMALL,
    "n_steps": 32,
    "batch_size": 128,
    "n_epochs": 2,
    "n_flow_steps": 4,
}


class Collector(BaseCallback):
    """Keeps what the diagnostics logged."""

    def _on_training_start(self) -> None:
        self.logged: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        prefix = "diagnostics/"
        figures = self.logger.name_to_value
        self.logged.append({k[len(prefix) :]: v for k, v in figures.items() if prefix in k})


def environment() -> VecEnv:
    return MultiGoalVecEnv(8, seed=0)


def diagnosed(iterations: int = 3, every: int = 1, **options: Any) -> list[dict[str, float]]:
    model = PolicyFlow("MlpPolicy", environment(), **{**OPTIONS, **options})
    collector = Collector()
    diagnostics = FlowDiagnosticsCallback(every=every, n_samples=200)
    model.learn(iterations * 256, [diagnostics, collector])
    return collector.logged


def test_small_updates_are_approximated_well_and_large_ones_worse() -> None:
    cautious, bold = (diagnosed(learning_rate=rate)[-1] for rate in (1e-4, 3e-2))
    assert cautious["log_ratio_correlation"] > 0.99
    assert cautious["shift_cosine"] > 0.9
    assert 0 < cautious["log_ratio_error"] < 0.1 * cautious["log_ratio_exact_std"]
    assert bold["log_ratio_error"] > 10 * cautious["log_ratio_error"]
    assert bold["shift_exact"] > 10 * cautious["shift_exact"]
    assert cautious["log_ratio_error"] < cautious["log_ratio_error_sampled"]


def test_training_is_the_same_with_and_without() -> None:
    runs = []
    for callback in (None, FlowDiagnosticsCallback(n_samples=16)):
        model = PolicyFlow("MlpPolicy", environment(), **OPTIONS).learn(512, callback)
        runs.append(weights(model))
    assert th.equal(*runs)


def test_every_so_many_rollouts() -> None:
    logged = diagnosed(iterations=5, every=2)
    measured = ["action_entropy" in figures for figures in logged]
    # Before the first rollout nothing; figures stay until the log is written.
    assert measured == [False, False, True, False, True]


def test_the_last_update_is_logged_too(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", environment(), **OPTIONS)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(2 * 256, FlowDiagnosticsCallback(n_samples=16))
    log = pd.read_csv(tmp_path / "progress.csv")
    assert log["time/total_timesteps"].tolist() == [256, 512, 512]
    assert log["diagnostics/kl_exact"].notna().tolist() == [False, True, True]


@pytest.mark.parametrize("interpolant", ["rectified", "trigflow"])
def test_shifts_of_constant_fields(interpolant: str) -> None:
    """A field that is constant in space and time moves all ends by its change times the length."""
    old, new = (
        PolicyFlow("MlpPolicy", environment(), interpolant=interpolant, **OPTIONS).learn(256)
        for _ in range(2)
    )
    for model, constant in ((old, 1.0), (new, 3.0)):
        with th.no_grad():
            model.policy.velocity.output.weight.zero_()
            model.policy.velocity.output.bias.fill_(constant)
    samples = old.rollout_buffer.samples()
    with th.no_grad():
        shifts = end_point_shifts(old.policy, new.policy, samples, th.rand(256, 3))
    expected = np.full((256, 2), 2.0 * {"rectified": 1.0, "trigflow": math.pi / 2}[interpolant])
    for shift in shifts:
        np.testing.assert_allclose(shift, expected, rtol=1e-5)


def test_entropy_of_a_policy_that_is_gaussian() -> None:
    """With a velocity of zero, an action is a latent plus noise, both of variance 1."""
    model = PolicyFlow("MlpPolicy", environment(), **{**OPTIONS, "learning_rate": 0.0})
    collector = Collector()
    diagnostics = FlowDiagnosticsCallback(n_entropy_states=64, n_entropy_actions=256)
    model.learn(512, [diagnostics, collector])
    expected = math.log(2 * math.pi * math.e * 2.0)  # of two dimensions
    assert collector.logged[-1]["action_entropy"] == pytest.approx(expected, abs=0.06)
    assert collector.logged[-1]["kl_exact"] == 0.0


@pytest.mark.parametrize("algorithm", [FPO, DPPO])
def test_other_algorithms(algorithm: type[Any]) -> None:
    runs = []
    for callbacks in ([], [FlowDiagnosticsCallback(n_samples=16), Collector()]):
        options = {name: value for name, value in OPTIONS.items() if name != "n_flow_steps"}
        model = algorithm("MlpPolicy", environment(), **options).learn(512, callbacks)
        runs.append(weights(model))
    assert list(callbacks[1].logged[-1]) == ["action_entropy"]
    assert th.equal(*runs)


def test_algorithms_without_a_flow() -> None:
    with pytest.raises(ValueError, match=r"looks at flow policies, .* not at PPO"):
        PPO("MlpPolicy", "Pendulum-v1").learn(16, FlowDiagnosticsCallback())


@pytest.mark.parametrize("options", [{"every": 0}, {"n_samples": 1}, {"n_entropy_actions": 1}])
def test_numbers_that_are_too_small(options: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be at least"):
        FlowDiagnosticsCallback(**options)


def test_returns_of_drawn_and_deterministic_actions() -> None:
    model = PolicyFlow("MlpPolicy", Monitor(TwoWays()), **{**OPTIONS, "batch_size": 32})
    env = make_vec_env(TwoWays, 2)
    diagnostics = FlowDiagnosticsCallback(eval_env=env, n_eval_episodes=40)
    collector = Collector()
    advice = r"Deterministic actions return 0 .* may be too few"
    with pytest.warns(UserWarning, match=advice) as told:
        model.learn(96, [diagnostics, collector])
    assert len(told) == 1
    assert collector.logged[-1]["return_deterministic"] == 0
    assert collector.logged[-1]["return_drawn"] > 0.5


@pytest.mark.parametrize(
    ("drawn", "deterministic", "told"),
    [
        ([900, 908, 910], [0, 0, 0], True),
        ([8.2, 8.4, 8.3], [2.0, 2.1, 1.9], True),
        ([-160, -170, -150], [-165, -140, -160], False),
        ([10, 1, 0, 20], [7, 0, 1, 9], False),  # could be chance
        ([0, 0], [900, 900], False),
        ([900], [0, 0], False),
    ],
)
def test_what_is_much_worse(drawn: list[float], deterministic: list[float], told: bool) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert warn_of_deterministic_actions(drawn, deterministic, "draw") is told
    assert len(caught) == told
