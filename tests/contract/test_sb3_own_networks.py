"""Networks that a policy builds as SB3 documents, and parameters that make the policy."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_policyflow import DPPO
from sb3_policyflow.common.policies import FlowPolicy
from tests.helpers import SMALL, TINY, train, weights


def make(algorithm: type[Any], policy: Any = "MlpPolicy", **options: Any) -> Any:
    return algorithm(policy, "Pendulum-v1", **{**SMALL, "policy_kwargs": TINY, **options})


def own(algorithm: type[Any], **methods: Any) -> type[Any]:
    return type("Own", (algorithm.policy_aliases["MlpPolicy"],), methods)


# Networks of one's own


class Networks(nn.Module):
    """Those of SB3's documentation."""

    def __init__(self, features_dim: int) -> None:
        super().__init__()
        self.latent_dim_pi, self.latent_dim_vf = 16, 12
        self.policy_net = nn.Sequential(nn.Linear(features_dim, 16), nn.ReLU())
        self.value_net = nn.Sequential(nn.Linear(features_dim, 12), nn.ReLU())

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        return self.policy_net(features)  # type: ignore[no-any-return]

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return self.value_net(features)  # type: ignore[no-any-return]


def own_networks(self: Any) -> None:
    self.mlp_extractor = Networks(self.features_dim)


def deeper(self: Any) -> None:
    arch = {"pi": [16], "vf": [12]}
    self.mlp_extractor = MlpExtractor(self.features_dim, arch, nn.ReLU)


def replaced(self: Any) -> None:
    FlowPolicy._build_mlp_extractor(self)
    self.mlp_extractor.policy_net = nn.Sequential(nn.Linear(self.features_dim, 16), nn.ReLU())
    self.mlp_extractor.latent_dim_pi = 16


@pytest.mark.parametrize("build", [own_networks, deeper, replaced])
@pytest.mark.parametrize("share", [True, False])
def test_an_actor_of_ones_own_acts_and_learns(
    algorithm: type[Any], build: Any, share: bool, tmp_path: Any
) -> None:
    kwargs = {**TINY, "initialization": "glorot", "share_features_extractor": share}
    policy_class = own(algorithm, _build_mlp_extractor=build)
    model = make(algorithm, policy_class, policy_kwargs=kwargs)
    actor = model.policy.mlp_extractor.policy_net
    observations = th.rand(5, 3).numpy()
    before, acted = weights(model), model.predict(observations, deterministic=True)[0]
    first = actor[0].weight.detach().clone()
    with th.no_grad():
        actor[0].weight.add_(1.0)
    assert not np.array_equal(model.predict(observations, deterministic=True)[0], acted)
    with th.no_grad():
        actor[0].weight.copy_(first)
    np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], acted)
    train(model, 32)
    assert not th.equal(actor[0].weight, first)
    assert len(before) == len(weights(model))
    model.save(tmp_path / "model")
    assert th.equal(weights(algorithm.load(tmp_path / "model")), weights(model))


def test_the_reference_policy_has_the_actor_of_ones_own(algorithm: type[Any]) -> None:
    """The first ratio of an update is 1."""
    policy_class = own(algorithm, _build_mlp_extractor=own_networks)
    kwargs = {**TINY, "initialization": "glorot"}
    model = make(algorithm, policy_class, policy_kwargs=kwargs, n_steps=8)
    model.learn(8)
    assert model.logger.name_to_value["train/log_ratio_max"] < 1e-5


def test_features_of_ones_own_are_those_of_the_reference_policy(algorithm: type[Any]) -> None:
    def extract_features(self: Any, obs: Any, features_extractor: Any = None) -> Any:
        features = ActorCriticPolicy.extract_features(self, obs, features_extractor)
        return 2 * features

    policy_class = own(algorithm, extract_features=extract_features)
    kwargs = {**TINY, "initialization": "glorot"}
    model = make(algorithm, policy_class, policy_kwargs=kwargs, n_steps=8)
    model.learn(8)
    assert model.logger.name_to_value["train/log_ratio_max"] < 1e-5
    doubled = model.policy.actor_features(th.ones(1, 3))
    assert th.equal(doubled, 2 * th.ones(1, 3))


def test_frozen_steps_keep_the_actor_of_ones_own() -> None:
    policy_class = own(DPPO, _build_mlp_extractor=own_networks)
    kwargs = {**TINY, "initialization": "glorot"}
    model = make(DPPO, policy_class, policy_kwargs=kwargs, n_finetuned_steps=4)
    base = model.policy.base_mlp_extractor
    before = base.policy_net[0].weight.clone()
    train(model, 32)
    assert th.equal(base.policy_net[0].weight, before)
    assert not th.equal(model.policy.mlp_extractor.policy_net[0].weight, before)
    model.policy.freeze_base()
    assert th.equal(base.policy_net[0].weight, model.policy.mlp_extractor.policy_net[0].weight)


def test_a_critic_that_learns_first_must_be_told_from_the_actor() -> None:
    class Unnamed(Networks):
        def __init__(self, features_dim: int) -> None:
            super().__init__(features_dim)
            self.critic = self.value_net
            del self.value_net

    def unnamed(self: Any) -> None:
        self.mlp_extractor = Unnamed(self.features_dim)

    policy_class = own(DPPO, _build_mlp_extractor=own_networks)
    train(make(DPPO, policy_class, n_critic_warmup=1), 16)
    with pytest.raises(TypeError, match=r"which part of Unnamed .* named value_net"):
        make(DPPO, own(DPPO, _build_mlp_extractor=unnamed), n_critic_warmup=1)


# Parameters


def test_parameters_make_the_policy(algorithm: type[Any]) -> None:
    kwargs = {**TINY, "initialization": "glorot"}
    model, copied, averaged = (make(algorithm, policy_kwargs=kwargs, seed=i) for i in range(3))
    copied.policy.load_from_vector(model.policy.parameters_to_vector())
    polyak_update(model.policy.parameters(), averaged.policy.parameters(), tau=1.0)
    observations = th.rand(5, 3).numpy()
    expected, _ = model.predict(observations, deterministic=True)
    for other in (copied, averaged):
        assert th.equal(weights(model), weights(other))
        np.testing.assert_array_equal(other.predict(observations, deterministic=True)[0], expected)


def test_frequencies_are_never_learned(algorithm: type[Any]) -> None:
    """Not even by one who lets all parameters learn again after some were frozen."""
    model = make(algorithm)
    model.policy.requires_grad_(True)
    embedding = model.policy.velocity.time_embedding
    frequencies = embedding.frequencies.clone()
    train(model, 32)
    assert th.equal(embedding.frequencies, frequencies)
    optimized = [p for group in model.policy.optimizer.param_groups for p in group["params"]]
    assert not any(parameter is embedding.frequencies for parameter in optimized)
