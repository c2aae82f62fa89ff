"""PolicyFlow is used as PPO is."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor

from sb3_policyflow import PolicyFlow
from sb3_policyflow.common.losses import SURROGATES
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.flows import INTERPOLANTS, SOLVERS
from tests.helpers import TWO_EPOCHS, n_updates, train, weights


@pytest.mark.parametrize("alias", ["MlpFlowPolicy", "MlpPolicy"])
@pytest.mark.parametrize("interpolant", INTERPOLANTS)
def test_every_interpolant_trains(alias: str, interpolant: str) -> None:
    model = PolicyFlow(
        alias, "Pendulum-v1", interpolant=interpolant, brownian_coef=0.1, **TWO_EPOCHS
    )
    train(model, 128)


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_and_time_sampler_trains(solver: str) -> None:
    for sampler, n_times, average in [("grid", 1, "objective"), ("uniform", 3, "shift")]:
        model = PolicyFlow(
            "MlpPolicy",
            "Pendulum-v1",
            solver=solver,
            n_flow_steps=3,
            time_sampler=sampler,
            n_times=n_times,
            time_average=average,
            **TWO_EPOCHS,
        )
        train(model, 64)


class NestedImages(gym.Env[Any, Any]):
    """A camera and joint angles, as robots have them."""

    observation_space = spaces.Dict(
        {
            "camera": spaces.Box(0, 255, (36, 36, 3), np.uint8),
            "joints": spaces.Box(-1, 1, (3,)),
            "gripper": spaces.Discrete(2),
        }
    )
    action_space = spaces.Box(-1, 1, (2, 2))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        assert action.shape == (2, 2)
        return self.observation_space.sample(), float(action.sum()), False, False, {}


@pytest.mark.parametrize("share", [True, False])
def test_dict_observations_with_images_and_actions_with_two_axes(share: bool) -> None:
    policy_kwargs = {"share_features_extractor": share}
    model = PolicyFlow(
        "MultiInputFlowPolicy", NestedImages(), policy_kwargs=policy_kwargs, **TWO_EPOCHS
    )
    train(model, 64)
    obs = NestedImages.observation_space.sample()
    assert model.predict(obs)[0].shape == (2, 2)
    assert model.rollout_buffer.latents.shape == (64, 1, 4)  # type: ignore[union-attr]


@pytest.mark.parametrize("net_arch", [[], [8], {"pi": [8, 8], "vf": [4]}, {"pi": []}])
def test_network_shapes(net_arch: Any) -> None:
    model = PolicyFlow(
        "MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": net_arch}, **TWO_EPOCHS
    )
    train(model, 64)
    expected = net_arch.get("pi", []) if isinstance(net_arch, dict) else net_arch
    sizes = [m.out_features for m in model.policy.velocity.hidden if isinstance(m, th.nn.Linear)]
    assert sizes == expected


def test_float64_actions_and_observations() -> None:
    class Float64(gym.Env[Any, Any]):
        observation_space = spaces.Box(-1, 1, (3,), np.float64)
        action_space = spaces.Box(-2, 1, (2,), np.float64)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return np.zeros(3), {}

        def step(self, action: Any) -> Any:
            assert self.action_space.contains(np.asarray(action, dtype=np.float64))
            return np.zeros(3), float(action.sum()), False, True, {}

    train(PolicyFlow("MlpPolicy", Float64(), **TWO_EPOCHS), 64)


def test_deterministic_actions_are_where_the_zero_latent_ends() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **TWO_EPOCHS).learn(64)
    obs = np.stack([model.observation_space.sample() for _ in range(5)])
    deterministic, _ = model.predict(obs, deterministic=True)
    with th.no_grad():
        features = model.policy.actor_features(th.as_tensor(obs))
        endpoints = model.policy.transport(th.zeros(5, 1), features)
    np.testing.assert_allclose(deterministic, endpoints.numpy().clip(-2, 2), rtol=1e-5)


def test_options_can_be_changed_on_load(tmp_path: Path) -> None:
    options = {"brownian_coef": "lin_0.25_0.05", "n_flow_steps": 4}
    policy_kwargs = {"latent_std": 0.5}
    model = PolicyFlow(
        "MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, **options, **TWO_EPOCHS
    )
    model.save(tmp_path / "model")
    same = PolicyFlow.load(tmp_path / "model")
    assert same.brownian_coef == "lin_0.25_0.05"
    assert (same.policy.n_flow_steps, same.policy.latent_std) == (4, 0.5)
    loaded = PolicyFlow.load(tmp_path / "model", n_flow_steps=2, brownian_coef=0.5)
    assert (loaded.policy.n_flow_steps, loaded.policy.latent_std) == (2, 0.5)
    loaded.set_env(make_vec_env("Pendulum-v1"))
    train(loaded, 64)


def test_policy_alone_can_be_saved(tmp_path: Path) -> None:
    policy_kwargs = {"frequencies": 3, "frequency_scale": 4.0, "net_arch": [16]}
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        interpolant="trigflow",
        n_flow_steps=3,
        solver="heun",
        policy_kwargs=policy_kwargs,
        **TWO_EPOCHS,
    ).learn(64)
    model.policy.save(tmp_path / "policy.pt")
    loaded = type(model.policy).load(tmp_path / "policy.pt")
    obs = model.observation_space.sample()
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )


def test_parameters_can_be_read_and_set() -> None:
    first, second = (PolicyFlow("MlpPolicy", "Pendulum-v1", **TWO_EPOCHS) for _ in range(2))
    first.learn(64)
    second.set_parameters(first.get_parameters())
    assert th.equal(weights(first), weights(second))


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


def test_callbacks_and_logs_on_disk(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    env, evaluation = make_vec_env("Pendulum-v1", 2), make_vec_env("Pendulum-v1")
    model = PolicyFlow("MlpPolicy", env, n_steps=100, batch_size=50, n_epochs=1)
    model.set_logger(configure(str(tmp_path), ["csv", "json", "tensorboard"]))
    model.learn(
        800,
        callback=[
            EvalCallback(evaluation, eval_freq=200, best_model_save_path=str(tmp_path)),
            CheckpointCallback(save_freq=200, save_path=str(tmp_path), save_vecnormalize=True),
        ],
        log_interval=1,
    )
    assert (tmp_path / "best_model.zip").exists()
    assert PolicyFlow.load(tmp_path / "rl_model_400_steps").num_timesteps == 400
    assert "train/brownian_loss" in (tmp_path / "progress.csv").read_text().splitlines()[0]
    assert any(tmp_path.glob("events.out.tfevents.*"))


def test_a_callback_can_stop_training() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **TWO_EPOCHS)
    model.learn(10_000, StopTrainingOnMaxEpisodes(max_episodes=1))
    assert model.num_timesteps == 200


def test_progress_bar(capsys: pytest.CaptureFixture[str]) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", **TWO_EPOCHS).learn(64, progress_bar=True)
    assert "64/64" in capsys.readouterr().out


@pytest.mark.slow
def test_multigoal_with_the_papers_settings() -> None:
    """Two iterations at full size run through and keep time limits and terminations apart."""
    env = VecMonitor(MultiGoalVecEnv(1024, seed=0))
    model = PolicyFlow(
        "MlpFlowPolicy",
        env,
        n_steps=24,
        batch_size=6144,
        n_epochs=5,
        learning_rate=2e-4,
        desired_kl=0.01,
        clip_range_vf=0.2,
        ent_coef=0.001,
        brownian_coef=0.25,
        vf_coef=1.0,
        max_grad_norm=1.0,
        policy_kwargs={"net_arch": [256, 128, 64], "activation_fn": th.nn.Mish},
        seed=0,
    ).learn(2 * 24_576)
    assert n_updates(model) == 10
    assert 0 < np.mean([episode["r"] for episode in model.ep_info_buffer]) < 10  # type: ignore[union-attr]


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
