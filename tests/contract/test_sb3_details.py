"""SB3's contract in its details: stacks, selected keys, estimates, windows, policies of one's own.

The tests have the names of SB3's own where it has them.
"""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecNormalize,
)

from tests.helpers import SMALL, TINY, weights


def make(algorithm: type[Any], env: Any, policy: str = "MlpPolicy", **options: Any) -> Any:
    return algorithm(policy, env, **{**SMALL, "policy_kwargs": TINY, **options})


# Images, stacks and normalized parts


def test_vec_framestack_of_images(algorithm: type[Any], tmp_path: Path) -> None:
    def frames() -> Any:
        screens = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
        return VecFrameStack(DummyVecEnv([lambda: screens]), n_stack=4)

    kwargs = {**TINY, "features_extractor_kwargs": {"features_dim": 8}}
    model = make(algorithm, frames(), "CnnPolicy", policy_kwargs=kwargs).learn(16)
    assert model.observation_space.shape == (4, 40, 40)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=frames())
    # As the environment gives them, with their channels last, or already turned.
    stack = frames().reset()
    turned = stack.transpose(0, 3, 1, 2)
    expected, _ = model.predict(turned, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(turned, deterministic=True)[0], expected)
    np.testing.assert_array_equal(loaded.predict(stack, deterministic=True)[0], expected)


class Screen(gym.Env[Any, Any]):
    """Pictures that are scaled to [0, 1] already."""

    observation_space = spaces.Box(0, 1, (3, 36, 36))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 0.0, False, False, {}


def test_image_like_input(algorithm: type[Any]) -> None:
    extractor = {"features_dim": 8, "normalized_image": True}
    kwargs = {**TINY, "normalize_images": False, "features_extractor_kwargs": extractor}
    model = make(algorithm, Screen(), "CnnPolicy", policy_kwargs=kwargs).learn(16)
    assert model.predict(Screen.observation_space.sample())[0].shape == (1,)
    with pytest.raises(AssertionError, match="NatureCNN"):
        make(algorithm, Screen(), "CnnPolicy")


def test_normalize_dict_selected_keys(algorithm: type[Any]) -> None:
    env: Any = VecNormalize(
        DummyVecEnv([lambda: SimpleMultiObsEnv(discrete_actions=False)]), norm_obs_keys=["vec"]
    )
    kwargs = {**TINY, "features_extractor_kwargs": {"cnn_output_dim": 4}}
    model = make(algorithm, env, "MultiInputPolicy", policy_kwargs=kwargs).learn(32)
    stored = model.rollout_buffer.observations
    assert stored["vec"].min() < -0.5 < 0.0 <= env.get_original_obs()["vec"].min()
    np.testing.assert_array_equal(stored["img"], stored["img"].astype(np.uint8))


# What is learned from


class Rewards(gym.Env[Any, Any]):
    """Pays 1 in each of its five steps."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        return np.zeros(1, np.float32), 1.0, self.time == 5, False, {}


class Rollout(BaseCallback):
    """Keeps the buffer's arrays before they are reshaped for training."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.locals["rollout_buffer"]
        names = ("advantages", "returns", "values", "episode_starts")
        self.arrays = {name: getattr(buffer, name)[:, 0].copy() for name in names}


@pytest.mark.parametrize("gae_lambda", [1.0, 0.9])
@pytest.mark.parametrize("gamma", [1.0, 0.99])
def test_env(algorithm: type[Any], gae_lambda: float, gamma: float) -> None:
    """Advantages are the sum of discounted errors to the end of the episode."""
    rollout = Rollout()
    model = make(algorithm, Rewards(), gamma=gamma, gae_lambda=gae_lambda, n_steps=15)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 15 is no multiple of the batch size
        model.learn(15, rollout)
    values = np.append(rollout.arrays["values"], 0.0)
    for start in range(0, 15, 5):
        ends = values[start : start + 6].copy()
        ends[5] = 0.0
        errors = 1.0 + gamma * ends[1:] - ends[:-1]
        for step in range(5):
            weight = (gamma * gae_lambda) ** np.arange(5 - step)
            found = rollout.arrays["advantages"][start + step]
            assert found == pytest.approx((weight * errors[step:]).sum(), abs=1e-4)
    total = rollout.arrays["advantages"] + rollout.arrays["values"]
    np.testing.assert_allclose(rollout.arrays["returns"], total, atol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(rollout.arrays["episode_starts"]), [0, 5, 10])


def test_vec_check_nan(algorithm: type[Any]) -> None:
    """SB3's own detector can stay around the environment."""
    env = VecCheckNan(DummyVecEnv([Rewards]), raise_exception=True)
    assert make(algorithm, env).learn(16).num_timesteps == 16


# Episodes and their ends


@pytest.mark.parametrize("stats_window_size", [1, 42])
def test_ep_buffers_stats_window_size(algorithm: type[Any], stats_window_size: int) -> None:
    model = make(algorithm, Rewards(), stats_window_size=stats_window_size).learn(32)
    assert model.ep_info_buffer.maxlen == stats_window_size
    assert model.ep_success_buffer.maxlen == stats_window_size
    assert len(model.ep_info_buffer) == min(stats_window_size, 32 // 5)


def test_callbacks_that_stop(algorithm: type[Any]) -> None:
    model = make(algorithm, Rewards()).learn(1000, StopTrainingOnMaxEpisodes(max_episodes=3))
    assert model.num_timesteps == 15
    patience = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=1)
    evaluation = EvalCallback(
        Monitor(Rewards()), callback_after_eval=patience, eval_freq=10, n_eval_episodes=1
    )
    # The second evaluation is as good as the first, and the third too.
    assert model.learn(1000, evaluation).num_timesteps == 30


def test_progress_bar(algorithm: type[Any]) -> None:
    pytest.importorskip("rich")
    pytest.importorskip("tqdm")
    assert make(algorithm, Rewards()).learn(16, progress_bar=True).num_timesteps == 16


# Policies


def test_custom_policy(algorithm: type[Any], tmp_path: Path) -> None:
    """A policy of one's own is given as a class, saved and loaded."""
    base = algorithm.policy_aliases["MlpPolicy"]
    policy_class = type("OwnPolicy", (base,), {"scale": 0.5, "sample_actions": _halved(base)})
    model = make(algorithm, IdentityEnvBox(-10, 10), policy_class).learn(16)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert type(loaded.policy).__name__ == "OwnPolicy"
    assert th.equal(weights(model), weights(loaded))
    observation = model.observation_space.sample()
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)


def _halved(base: type[Any]) -> Any:
    def sample_actions(self: Any, features: th.Tensor, deterministic: bool = False) -> Any:
        actions, record = base.sample_actions(self, features, deterministic)
        return actions * self.scale, record

    return sample_actions


def test_mixing_gym_vecenv_api(algorithm: type[Any]) -> None:
    env = gym.make("Pendulum-v1")
    with pytest.raises(ValueError, match="mixing Gym API with SB3 VecEnv API"):
        make(algorithm, env).predict(env.reset())


def test_no_warnings_from_construction_to_loading(algorithm: type[Any], tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = VecNormalize(make_vec_env("Pendulum-v1", 2))
        model = make(algorithm, env, desired_kl=0.01, clip_range_vf=0.2).learn(64)
        model.save(tmp_path / "model")
        loaded = algorithm.load(tmp_path / "model", env=env)
        loaded.learn(32, reset_num_timesteps=False)


def test_print_system_info(
    algorithm: type[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(algorithm, Rewards()).save(tmp_path / "model")
    algorithm.load(tmp_path / "model", print_system_info=True)
    assert "Stable-Baselines3" in capsys.readouterr().out
