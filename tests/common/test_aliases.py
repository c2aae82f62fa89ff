"""Policies by the names of SB3."""

from typing import Any

import pytest
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN

from tests.helpers import SMALL, TINY

KINDS = {
    "Mlp": (FlattenExtractor, lambda: IdentityEnvBox()),
    "Cnn": (NatureCNN, lambda: FakeImageEnv(40, 40, n_channels=1, discrete=False)),
    "MultiInput": (CombinedExtractor, lambda: SimpleMultiObsEnv(discrete_actions=False)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_both_names_are_one_policy_with_sb3s_extractor(algorithm: type[Any], kind: str) -> None:
    extractor, make_env = KINDS[kind]
    policies = algorithm.policy_aliases
    assert policies[f"{kind}Policy"] is policies[f"{kind}FlowPolicy"]
    model = algorithm(f"{kind}Policy", make_env(), policy_kwargs=TINY, **SMALL)
    assert isinstance(model.policy, policies[f"{kind}Policy"])
    assert type(model.policy.features_extractor) is extractor


def test_another_extractor_can_be_given(algorithm: type[Any]) -> None:
    class Own(FlattenExtractor):
        pass

    env = FakeImageEnv(8, 8, n_channels=1, discrete=False)
    kwargs = {**TINY, "features_extractor_class": Own}
    model = algorithm("CnnPolicy", env, policy_kwargs=kwargs, **SMALL)
    assert type(model.policy.features_extractor) is Own


def test_policies_are_the_algorithms_own(algorithm: type[Any]) -> None:
    module = algorithm.__module__.rpartition(".")[0]
    for policy in algorithm.policy_aliases.values():
        assert policy.__module__.startswith(module)
        assert issubclass(policy, algorithm.policy_base)
