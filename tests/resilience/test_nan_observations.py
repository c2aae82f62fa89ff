"""Observations with NaN stop training, unless the user says that the extractor handles them."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tests.helpers import SMALL, TINY, train


class Gaps(gym.Env[Any, Any]):
    """Readings of which some are missing, and a reward that may be."""

    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, is_dict: bool = False, reward: float = 1.0, missing: float = np.nan) -> None:
        box = spaces.Box(-1, 1, (3,))
        self.observation_space = spaces.Dict({"a": box, "b": box}) if is_dict else box
        self.is_dict, self.reward, self.missing, self.time = is_dict, reward, missing, 0

    def observe(self) -> Any:
        gap = np.array([self.missing, 0.5, -0.5], np.float32)
        return {"a": np.zeros(3, np.float32), "b": gap} if self.is_dict else gap

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        return self.observe(), self.reward, False, self.time % 5 == 0, {}


class Filled(FlattenExtractor):
    """Takes 0 for what is missing."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(th.nan_to_num(observations))


class FilledDict(CombinedExtractor):
    """Takes 0 for what is missing."""

    def forward(self, observations: Any) -> th.Tensor:
        return super().forward({key: th.nan_to_num(value) for key, value in observations.items()})


def make(algorithm: type[Any], env: Any, **options: Any) -> Any:
    is_dict = isinstance(env.observation_space, spaces.Dict)
    kwargs = {**TINY, "features_extractor_class": FilledDict if is_dict else Filled}
    policy = "MultiInputPolicy" if is_dict else "MlpPolicy"
    return algorithm(policy, env, policy_kwargs=kwargs, **SMALL, **options)


@pytest.mark.parametrize("is_dict", [False, True])
def test_missing_readings_stop_training_by_default(algorithm: type[Any], is_dict: bool) -> None:
    with pytest.raises(FloatingPointError, match=r"environment's observation .*is not finite"):
        make(algorithm, Gaps(is_dict)).learn(16)


@pytest.mark.parametrize("is_dict", [False, True])
@pytest.mark.parametrize("timeout_bootstrap", ["terminal", "current"])
def test_missing_readings_can_be_meant(
    algorithm: type[Any], is_dict: bool, timeout_bootstrap: str, tmp_path: Path
) -> None:
    options = {"allow_nan_observations": True, "timeout_bootstrap": timeout_bootstrap}
    model = train(make(algorithm, Gaps(is_dict), **options), 32)
    model.save(tmp_path / "model")
    train(algorithm.load(tmp_path / "model", env=Gaps(is_dict)), 16)


def test_only_observations_may_be_missing(algorithm: type[Any]) -> None:
    with pytest.raises(FloatingPointError, match="environment's reward is not finite"):
        make(algorithm, Gaps(reward=np.nan), allow_nan_observations=True).learn(16)


def test_an_extractor_that_does_not_handle_them_is_found_out(algorithm: type[Any]) -> None:
    model = algorithm("MlpPolicy", Gaps(), policy_kwargs=TINY, allow_nan_observations=True, **SMALL)
    with pytest.raises(FloatingPointError, match="policy's action is not finite"):
        model.learn(16)


def half(is_dict: bool, **options: Any) -> VecNormalize:
    """Two environments, the second of which misses readings."""
    makers = [lambda: Gaps(is_dict, missing=0.0), lambda: Gaps(is_dict)]
    return VecNormalize(DummyVecEnv(makers), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("is_dict", [False, True])
def test_normalization_does_not_spread_them(algorithm: type[Any], is_dict: bool) -> None:
    model = make(algorithm, half(is_dict), allow_nan_observations=True)
    with pytest.raises(FloatingPointError, match=r"normalized observation.* keep NaN out of VecNo"):
        model.learn(32)
    train(make(algorithm, half(is_dict, norm_obs=False), allow_nan_observations=True), 32)


def test_normalization_may_leave_out_the_keys_with_gaps(algorithm: type[Any]) -> None:
    env = half(is_dict=True, norm_obs_keys=["a"])
    train(make(algorithm, env, allow_nan_observations=True), 32)


@pytest.mark.parametrize("is_dict", [False, True])
def test_the_environment_is_named_behind_normalization(algorithm: type[Any], is_dict: bool) -> None:
    """Whose number it was, though it has been spread over all of them."""
    with pytest.raises(FloatingPointError, match=r"environment's observation .*in environment 1"):
        make(algorithm, half(is_dict)).learn(32)
