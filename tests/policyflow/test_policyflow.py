"""PolicyFlow is used as PPO is."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor

from sb3_policyflow import PolicyFlow
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


def test_deterministic_actions_may_be_where_the_zero_latent_ends() -> None:
    model = PolicyFlow(
        "MlpPolicy",
        "Pendulum-v1",
        policy_kwargs={"deterministic_action": "zero"},
        **TWO_EPOCHS,
    ).learn(64)
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
