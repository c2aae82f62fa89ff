"""A critic that learns before its actor does, in every algorithm."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import collected, learned

ALGORITHMS = [PolicyFlow, FPO, DPPO]


def actor(model: Any) -> th.Tensor:
    """All that an action depends on, in one vector."""
    critic = {id(parameter) for parameter in model.policy.critic_parameters()}
    parts = [p.detach().flatten() for p in learned(model.policy) if id(p) not in critic]
    return th.cat(parts)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_only_the_critic_warms_up(algorithm: type[Any]) -> None:
    options = {"n_steps": 64, "n_epochs": 3, "n_critic_warmup": 2, "ent_coef": 0.01, "seed": 0}
    model = algorithm("MlpPolicy", "Pendulum-v1", desired_kl=0.01, **options)
    untrained = actor(model)
    critic = model.policy.value_net.weight.clone()
    model.learn(2 * 64)
    assert th.equal(actor(model), untrained)
    assert not th.equal(model.policy.value_net.weight, critic)
    assert model.adaptive_learning_rate == 3e-4  # it must not move while the actor rests
    model.learn(64, reset_num_timesteps=False)
    assert not th.equal(actor(model), untrained)


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_critic_warms_up_without_the_extractor_of_the_actor(
    algorithm: type[Any], share: bool
) -> None:
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    policy_kwargs = {"initialization": "glorot", "share_features_extractor": share}
    sizes: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 4, "learning_rate": 1e-3}
    model = algorithm(
        "CnnPolicy", env, policy_kwargs=policy_kwargs, n_critic_warmup=2, seed=0, **sizes
    )
    obs = model.observation_space.sample()
    before = model.predict(obs, deterministic=True)[0]
    critic = model.policy.value_net.weight.clone()
    model.learn(2 * 32)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], before)
    assert not th.equal(model.policy.value_net.weight, critic)
    model.learn(32, reset_num_timesteps=False)
    assert not np.array_equal(model.predict(obs, deterministic=True)[0], before)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_warming_up_takes_rollouts_however_long_their_updates(algorithm: type[Any]) -> None:
    model, _ = collected(algorithm, n_critic_warmup=2)
    model.n_epochs = 4
    untrained = actor(model)
    model.train()
    assert th.equal(actor(model), untrained)
    model.train()
    assert not th.equal(actor(model), untrained)


def test_a_critic_that_has_warmed_up_does_not_do_so_again(tmp_path: Any) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=64, n_critic_warmup=1, seed=0)
    model.learn(64).save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    untrained = actor(loaded)
    loaded.learn(64, reset_num_timesteps=False)
    assert not th.equal(actor(loaded), untrained)
