"""One update of PolicyFlow: its learning rate, its advantages, its bounds and its log."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
)
from stable_baselines3.common.env_util import make_vec_env

from sb3_policyflow import PolicyFlow
from sb3_policyflow.common.losses import SURROGATES
from tests.helpers import TWO_EPOCHS, n_updates, weights


class Figures(BaseCallback):
    """Collects what is logged at the end of each update."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.logged = getattr(self, "logged", [])
        self.logged.append(dict(self.logger.name_to_value))


def test_log_keys_are_those_of_ppo_and_ours() -> None:
    env = make_vec_env("Pendulum-v1", 4)
    model = PolicyFlow("MlpPolicy", env, n_steps=200, batch_size=400, clip_range_vf=0.2, seed=0)
    callback = Figures()
    model.learn(2_400, callback, log_interval=1)
    logged = callback.logged[-1]
    ppo = ["policy_gradient_loss", "value_loss", "approx_kl", "clip_fraction", "clip_range"]
    ppo += ["clip_range_vf", "explained_variance", "learning_rate", "loss", "n_updates", "std"]
    own = ["entropy_loss", "brownian_loss", "velocity_change", "ratio_mean", "log_ratio_max"]
    for key in ppo + own:
        assert np.isfinite(logged[f"train/{key}"])
    assert logged["train/n_updates"] == 20
    assert 0 < logged["train/approx_kl"] < 0.5


def test_learning_rate_follows_the_divergence() -> None:
    def rates(**options: Any) -> list[float]:
        model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=256, seed=0, **options)
        callback = Figures()
        model.learn(256 * 3, callback)
        return [entry["train/learning_rate"] for entry in callback.logged[1:]]

    assert rates() == [3e-4, 3e-4]
    falling = rates(desired_kl=1e-7)
    assert falling[0] == 3e-4
    assert falling[1] == pytest.approx(3e-4 / 1.5**10)  # ten epochs
    rising = rates(
        desired_kl=10.0, lr_adaptation_kwargs={"interval": "minibatch", "bounds": (1e-6, 5e-4)}
    )
    assert rising[1] == 5e-4


def test_divergence_to_follow_may_change() -> None:
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        n_steps=256,
        seed=0,
        desired_kl=lambda remaining: 10.0 if remaining > 0.4 else 1e-7,
        lr_adaptation_kwargs={"bounds": (1e-6, 5e-4)},
    )
    model.learn(512)  # up to the bound, then down after each of ten epochs
    assert model.adaptive_learning_rate == pytest.approx(5e-4 / 1.5**10)


def test_target_kl_stops_the_update() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=256, target_kl=1e-6, seed=0)
    model.learn(256)
    assert n_updates(model) == 1  # of ten epochs
    whole = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=256, seed=0).learn(256)
    assert n_updates(whole) == 10


@pytest.mark.parametrize("interval", ["epoch", "minibatch"])
def test_update_that_is_stopped_lowers_the_learning_rate(interval: str) -> None:
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        n_steps=256,
        learning_rate=1e-2,
        target_kl=1e-4,
        desired_kl=5e-5,
        lr_adaptation_kwargs={"interval": interval},
        seed=0,
    )
    model.learn(256)
    assert n_updates(model) == 1
    assert model.adaptive_learning_rate is not None
    assert model.adaptive_learning_rate < 1e-2


@pytest.mark.parametrize("off", [None, 0.0, -1.0])
def test_gradient_clipping_can_be_turned_off(off: float | None) -> None:
    runs = []
    for max_grad_norm in (off, 1e9, 1e-9):
        model = PolicyFlow("MlpPolicy", "Pendulum-v1", max_grad_norm=max_grad_norm, **TWO_EPOCHS)
        runs.append(weights(model.learn(64)))
    unclipped, loose, tight = runs
    assert th.equal(unclipped, loose)
    assert not th.equal(unclipped, tight)


@pytest.mark.parametrize("scope", ["minibatch", "rollout"])
def test_advantages_are_normalized_where_asked(scope: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[th.Tensor] = []
    surrogate = SURROGATES["ppo"]

    def recording(log_ratio: th.Tensor, advantages: th.Tensor, clip_range: Any) -> th.Tensor:
        seen.append(advantages.flatten())
        return surrogate(log_ratio, advantages, clip_range)

    monkeypatch.setitem(SURROGATES, "ppo", recording)
    options = {**TWO_EPOCHS, "n_epochs": 1}
    PolicyFlow("MlpPolicy", "Pendulum-v1", advantage_scope=scope, **options).learn(64)
    assert [len(advantages) for advantages in seen] == [32, 32]
    for normalized in [th.cat(seen)] if scope == "rollout" else seen:
        assert normalized.mean().item() == pytest.approx(0.0, abs=1e-5)
        assert normalized.std().item() == pytest.approx(1.0, abs=1e-4)
    assert (abs(seen[0].mean().item()) < 1e-5) == (scope == "minibatch")


def test_a_gradient_that_is_not_finite_leaves_the_parameters_alone() -> None:
    options = {**TWO_EPOCHS, "batch_size": 64}
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **options).learn(64)
    model.rollout_buffer.returns[3] = np.nan
    before = weights(model)
    with pytest.raises(FloatingPointError, match="loss is not finite"):
        model.train()
    assert th.equal(weights(model), before)


def test_noise_comes_back_from_its_bounds() -> None:
    """A log standard deviation that has gone beyond would have no gradient there."""
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        n_steps=64,
        seed=0,
        ent_coef=10.0,
        policy_kwargs={"log_std_init": -2.0, "log_std_bounds": (-0.7, 0.0)},
    )
    log_std = model.policy.log_std
    assert log_std.item() == pytest.approx(-0.7)
    model.learn(64)
    assert -0.7 < log_std.item() < 0.0
    with th.no_grad():
        log_std.fill_(-0.001)
    model.learn(64)
    assert log_std.item() <= 0.0


def test_load_with_another_learning_rate_is_followed(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=64, seed=0, desired_kl=10.0)
    model.learn(64).save(tmp_path / "model")
    adapted = model.adaptive_learning_rate
    assert adapted is not None
    assert adapted > 3e-4

    def load(**changed: Any) -> PolicyFlow:
        return PolicyFlow.load(tmp_path / "model", env=model.get_env(), **changed)

    assert load().adaptive_learning_rate == adapted
    assert load(desired_kl=5.0).adaptive_learning_rate == adapted
    assert load(learning_rate=1e-4).adaptive_learning_rate == 1e-4
    fixed = load(desired_kl=None, learning_rate=1e-4).learn(64)
    assert fixed.adaptive_learning_rate is None
    assert fixed.policy.optimizer.param_groups[0]["lr"] == 1e-4
