"""SB3's contract for layers that act differently while they learn, under SB3's names."""

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from tests.helpers import SMALL, TINY, collect


class BatchNormDropoutExtractor(BaseFeaturesExtractor):
    """Layers that act differently while they learn."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 8) -> None:
        super().__init__(observation_space, features_dim)
        size = int(np.prod(observation_space.shape))
        self.norm = nn.BatchNorm1d(size)
        self.layers = nn.Sequential(nn.Linear(size, features_dim), nn.Dropout(0.5))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features: th.Tensor = self.layers(self.norm(observations))
        return features


def with_modes(algorithm: type[Any], **options: Any) -> Any:
    kwargs = {"features_extractor_class": BatchNormDropoutExtractor}
    return algorithm(
        "MlpPolicy", IdentityEnvBox(-10, 10), policy_kwargs={**TINY, **kwargs}, **SMALL, **options
    )


def statistics(model: Any) -> list[th.Tensor]:
    norm = model.policy.features_extractor.norm
    return [norm.running_mean.clone(), norm.running_var.clone()]


def test_a2c_ppo_train_with_batch_norm(algorithm: type[Any]) -> None:
    model = with_modes(algorithm)
    before = statistics(model)
    model.learn(32)
    assert not any(th.equal(one, two) for one, two in zip(before, statistics(model), strict=True))


def test_a2c_ppo_collect_rollouts_with_batch_norm(algorithm: type[Any]) -> None:
    """Acting changes no statistics, and an update changes them once in each minibatch."""
    model = with_modes(algorithm)
    before = statistics(model)
    for _ in range(3):
        collect(model)
    assert all(th.equal(one, two) for one, two in zip(before, statistics(model), strict=True))
    model.train()
    assert model.policy.features_extractor.norm.num_batches_tracked.item() == 16 // 8


def test_predict_with_dropout_batch_norm(algorithm: type[Any]) -> None:
    model = with_modes(algorithm).learn(32)
    before = statistics(model)
    obs = np.stack([model.observation_space.sample() for _ in range(4)])
    first, second = (model.predict(obs, deterministic=True)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert all(th.equal(one, two) for one, two in zip(before, statistics(model), strict=True))


def test_set_training_mode(algorithm: type[Any]) -> None:
    policy = with_modes(algorithm).policy
    for mode in (True, False, True):
        policy.set_training_mode(mode)
        assert all(module.training is mode for module in policy.modules())
    policy.predict(policy.observation_space.sample())
    assert not policy.training


def test_statistics_are_saved(algorithm: type[Any], tmp_path: Path) -> None:
    model = with_modes(algorithm).learn(32)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    loaded = algorithm.load(tmp_path / "model")
    assert all(map(th.equal, statistics(model), statistics(loaded)))
    policy = type(model.policy).load(tmp_path / "policy")
    observations = np.stack([model.observation_space.sample() for _ in range(4)])
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)
