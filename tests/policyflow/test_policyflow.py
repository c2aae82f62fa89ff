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
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv

SMALL: dict[str, Any] = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "seed": 0}


def parameters(model: PolicyFlow) -> list[th.Tensor]:
    return [parameter.detach().clone() for parameter in model.policy.parameters()]


def test_learns_to_copy_its_observation() -> None:
    env = IdentityEnvBox(eps=0.3)
    model = PolicyFlow("MlpFlowPolicy", env, n_steps=512, seed=0, learning_rate=1e-3, gamma=0.4)
    untrained, _ = evaluate_policy(model, model.get_env(), 10)
    model.learn(8_000)
    trained, _ = evaluate_policy(model, model.get_env(), 10)
    assert trained > max(untrained, 80)  # of at most 100


@pytest.mark.parametrize("alias", ["MlpFlowPolicy", "MlpPolicy"])
@pytest.mark.parametrize("path", ["rectified", "stochastic", "stochastic_exact", "trigflow"])
def test_every_path_trains(alias: str, path: str) -> None:
    model = PolicyFlow(alias, "Pendulum-v1", path=path, brownian_coef=0.1, **SMALL)
    before = parameters(model)
    model.learn(128)
    assert any(not th.equal(old, new) for old, new in zip(before, parameters(model), strict=True))
    assert all(th.isfinite(parameter).all() for parameter in parameters(model))


@pytest.mark.parametrize("solver", ["euler", "midpoint", "heun", "rk4", "ab2"])
def test_every_solver_and_time_sampler_trains(solver: str) -> None:
    for sampler, n_times, average in [("grid", 1, "objective"), ("uniform", 3, "shift")]:
        PolicyFlow(
            "MlpPolicy",
            "Pendulum-v1",
            solver=solver,
            n_flow_steps=3,
            time_sampler=sampler,
            n_times=n_times,
            time_average=average,
            **SMALL,
        ).learn(64)


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
    model = PolicyFlow("MultiInputFlowPolicy", NestedImages(), policy_kwargs=policy_kwargs, **SMALL)
    model.learn(64)
    obs = NestedImages.observation_space.sample()
    assert model.predict(obs)[0].shape == (2, 2)
    assert model.rollout_buffer.latents.shape == (64, 1, 4)  # type: ignore[union-attr]


def test_simple_dict_observations() -> None:
    model = PolicyFlow("MultiInputPolicy", SimpleMultiObsEnv(discrete_actions=False), **SMALL)
    model.learn(64)


@pytest.mark.parametrize("share", [True, False])
def test_images(share: bool) -> None:
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    stacked = VecFrameStack(make_vec_env(lambda: env), 4)
    policy_kwargs = {"share_features_extractor": share}
    model = PolicyFlow("CnnFlowPolicy", stacked, policy_kwargs=policy_kwargs, **SMALL).learn(64)
    mean, _ = evaluate_policy(model, model.get_env(), 2)  # type: ignore[arg-type]
    assert np.isfinite(mean)
    assert model.policy.velocity.hidden[0].in_features == 5 + 64  # type: ignore[union-attr]


@pytest.mark.parametrize("net_arch", [[], [8], {"pi": [8, 8], "vf": [4]}, {"pi": []}])
def test_network_shapes(net_arch: Any) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": net_arch}, **SMALL)
    model.learn(64)
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

    PolicyFlow("MlpPolicy", Float64(), **SMALL).learn(64)


def test_predict() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL).learn(64)
    obs = np.stack([model.observation_space.sample() for _ in range(5)])
    deterministic, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(deterministic, model.predict(obs, deterministic=True)[0])
    assert deterministic.shape == (5, 1)
    assert not np.array_equal(model.predict(obs)[0], model.predict(obs)[0])
    with th.no_grad():
        features = model.policy.actor_features(th.as_tensor(obs))
        endpoints = model.policy.carry(th.zeros(5, 1), features)
    np.testing.assert_allclose(deterministic, endpoints.numpy().clip(-2, 2), rtol=1e-5)


def test_saved_model_acts_and_goes_on_as_before(tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 2))
    model = PolicyFlow(
        "MlpPolicy",
        env,
        n_steps=32,
        batch_size=32,
        desired_kl=0.01,
        brownian_coef="lin_0.25_0.05",
        path="trigflow",
        n_flow_steps=4,
        solver="rk4",
        policy_kwargs={"embedding_dim": 8, "log_std_bounds": (-5.0, 2.0), "latent_std": 0.5},
    )
    model.learn(256)
    assert model.adaptive_learning_rate != 3e-4
    model.save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", env=env)
    assert loaded.adaptive_learning_rate == model.adaptive_learning_rate
    assert loaded.policy.optimizer.param_groups[0]["lr"] == model.adaptive_learning_rate
    assert loaded.brownian_coef == "lin_0.25_0.05"
    assert loaded.policy.n_flow_steps == 4
    assert loaded.policy.latent_std == 0.5
    obs = env.reset()
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )
    loaded.learn(128, reset_num_timesteps=False)
    assert loaded.num_timesteps == 256 + 128


def test_options_can_be_changed_on_load(tmp_path: Path) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL).save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", n_flow_steps=2, brownian_coef=0.5)
    assert loaded.policy.n_flow_steps == 2
    loaded.set_env(make_vec_env("Pendulum-v1"))
    loaded.learn(64)


def test_policy_alone_can_be_saved(tmp_path: Path) -> None:
    policy_kwargs = {"frequencies": 3, "frequency_scale": 4.0, "net_arch": [16]}
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        path="trigflow",
        n_flow_steps=3,
        solver="heun",
        policy_kwargs=policy_kwargs,
        **SMALL,
    ).learn(64)
    model.policy.save(tmp_path / "policy.pt")
    loaded = type(model.policy).load(tmp_path / "policy.pt")
    obs = model.observation_space.sample()
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )


def test_parameters_can_be_read_and_set() -> None:
    first, second = (PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL) for _ in range(2))
    first.learn(64)
    second.set_parameters(first.get_parameters())
    for one, other in zip(parameters(first), parameters(second), strict=True):
        assert th.equal(one, other)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_same_seed_same_run(n_envs: int) -> None:
    runs = []
    for _ in range(2):
        env = make_vec_env("Pendulum-v1", n_envs)
        model = PolicyFlow("MlpPolicy", env, n_steps=32, batch_size=16, seed=7).learn(128)
        runs.append(parameters(model))
    assert all(th.equal(one, other) for one, other in zip(*runs, strict=True))


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
    rising = rates(desired_kl=10.0, lr_adaptation="minibatch", lr_bounds=(1e-6, 5e-4))
    assert rising[1] == 5e-4


def test_divergence_to_follow_may_change() -> None:
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        n_steps=256,
        seed=0,
        desired_kl=lambda remaining: 10.0 if remaining > 0.4 else 1e-7,
        lr_bounds=(1e-6, 5e-4),
    )
    model.learn(512)  # up to the bound, then down after each of ten epochs
    assert model.adaptive_learning_rate == pytest.approx(5e-4 / 1.5**10)


def test_target_kl_stops_the_update() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=256, target_kl=1e-6, seed=0)
    model.learn(256)
    assert model._n_updates == 1  # of ten epochs
    whole = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=256, seed=0).learn(256)
    assert whole._n_updates == 10


@pytest.mark.parametrize("lr_adaptation", ["epoch", "minibatch"])
def test_update_that_is_stopped_lowers_the_learning_rate(lr_adaptation: str) -> None:
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        n_steps=256,
        learning_rate=1e-2,
        target_kl=1e-4,
        desired_kl=5e-5,
        lr_adaptation=lr_adaptation,
        seed=0,
    )
    model.learn(256)
    assert model._n_updates == 1
    assert model.adaptive_learning_rate is not None
    assert model.adaptive_learning_rate < 1e-2


@pytest.mark.parametrize("off", [None, 0.0, -1.0])
def test_gradient_clipping_can_be_turned_off(off: float | None) -> None:
    runs = []
    for max_grad_norm in (off, 1e9, 1e-9):
        model = PolicyFlow("MlpPolicy", "Pendulum-v1", max_grad_norm=max_grad_norm, **SMALL)
        runs.append(parameters(model.learn(64)))
    unclipped, loose, tight = runs
    assert all(th.equal(one, other) for one, other in zip(unclipped, loose, strict=True))
    assert not all(th.equal(one, other) for one, other in zip(unclipped, tight, strict=True))


@pytest.mark.parametrize("scope", ["minibatch", "rollout"])
def test_advantages_are_normalized_where_asked(scope: str) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", advantage_scope=scope, **SMALL).learn(64)
    rollout = model._rollout()
    batch = next(model.rollout_buffer.minibatches(rollout, 32))
    used = model._advantages(batch)
    whole = rollout.advantages if scope == "rollout" else used
    assert whole.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert whole.std().item() == pytest.approx(1.0, abs=1e-4)


def test_a_gradient_that_is_not_finite_leaves_the_parameters_alone() -> None:
    options = {**SMALL, "batch_size": 64}
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **options).learn(64)
    model.rollout_buffer.returns[3] = np.nan
    before = parameters(model)
    with pytest.raises(FloatingPointError, match="loss is not finite"):
        model.train()
    for old, new in zip(before, parameters(model), strict=True):
        assert th.equal(old, new)


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
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL)
    model.learn(10_000, StopTrainingOnMaxEpisodes(max_episodes=1))
    assert model.num_timesteps == 200


def test_progress_bar(capsys: pytest.CaptureFixture[str]) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL).learn(64, progress_bar=True)
    assert "64/64" in capsys.readouterr().out


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
    assert model._n_updates == 10
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
