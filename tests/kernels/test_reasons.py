"""Whoever loses the kernels can learn why."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_policyflow import DPPO, PolicyFlow
from sb3_policyflow.common.critic import CriticExtractor
from sb3_policyflow.flows import VelocityField
from sb3_policyflow.kernels import reason_kernels_are_off
from sb3_policyflow.kernels.activations import KNOWN


def make_policy(algorithm: Any = PolicyFlow, **policy_kwargs: Any) -> Any:
    return algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, device="cpu").policy


@pytest.mark.parametrize("algorithm", [PolicyFlow, DPPO])
def test_there_is_none_where_kernels_work(algorithm: Any) -> None:
    policy = make_policy(algorithm, activation_fn=nn.Mish)
    assert reason_kernels_are_off(policy) is None
    assert reason_kernels_are_off(copy.deepcopy(policy)) is None


def watch_actor(policy: Any) -> None:
    policy.velocity.hidden[1].register_forward_hook(lambda *_: None)


def watch_critic(policy: Any) -> None:
    policy.value_net.register_forward_hook(lambda *_: None)


def transpose(policy: Any) -> None:
    weight = policy.velocity.hidden[2].weight
    weight.data = weight.data.T


def replace_field(policy: Any) -> None:
    policy.velocity = VelocityField(1, 3)


def replace_layer(policy: Any) -> None:
    policy.velocity.hidden[0] = nn.LazyLinear(64)


def mix_activations(policy: Any) -> None:
    policy.velocity.hidden[1] = nn.ReLU()


class Doubled(nn.Sequential):
    """Layers that do more than a sequence of them."""

    def forward(self, features: th.Tensor) -> Any:
        return 2.0 * super().forward(features)


def replace_hidden_layers(policy: Any) -> None:
    policy.velocity.hidden = Doubled(*policy.velocity.hidden)


def replace_time_embedding(policy: Any) -> None:
    embedding = policy.velocity.time_embedding
    embedding.mlp = Doubled(*embedding.mlp)


def replace_critic(policy: Any) -> None:
    policy.mlp_extractor.value_net = Doubled(*policy.mlp_extractor.value_net)


def set_forward_critic(policy: Any) -> None:
    networks = policy.mlp_extractor
    networks.forward_critic = lambda features: networks.value_net(features) + 1.0


class Shifted(CriticExtractor):
    """The critic's layers, differently used."""

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return super().forward_critic(features) + 1.0


def derive_critic(policy: Any) -> None:
    policy.mlp_extractor = Shifted(3, [64, 64], nn.Tanh, policy.device)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (watch_actor, "Tanh has hooks"),
        (watch_critic, "for the critic, Linear has hooks"),
        (nn.Module.double, "parameters are torch.float64, not torch.float32"),
        (lambda policy: policy.to("meta"), "the policy is on meta"),
        (transpose, "parameters are not contiguous"),
        (replace_field, "VelocityField is not a velocity field of kernels"),
        (replace_layer, "LazyLinear takes the place of a linear layer"),
        (mix_activations, "a network is not linear layers with one activation between them"),
        (replace_hidden_layers, "Doubled takes the place of a sequence"),
        (replace_time_embedding, "Doubled takes the place of a sequence"),
        (replace_critic, "for the critic, Doubled takes the place of a sequence"),
        (set_forward_critic, "for the critic, CriticExtractor has a forward_critic of its own"),
        (derive_critic, "for the critic, Shifted has a forward_critic of its own"),
    ],
)
def test_what_was_done_to_a_policy(change: Callable[[Any], object], reason: str) -> None:
    policy = make_policy()
    assert reason_kernels_are_off(policy) is None
    change(policy)
    assert reason_kernels_are_off(policy) == reason


@pytest.mark.parametrize("change", [replace_critic, set_forward_critic, derive_critic])
def test_a_critic_of_ones_own_has_its_own_values(change: Callable[[Any], object]) -> None:
    policy = make_policy()
    features = th.rand(5, 3)
    before = policy.values(features)  # has read the critic
    change(policy)
    expected = policy.value_net(policy.mlp_extractor.forward_critic(features))
    th.testing.assert_close(policy.values(features), expected, rtol=0, atol=0)
    assert not th.allclose(expected, before)


@pytest.mark.parametrize("activation", [nn.Hardtanh(-2, 2), nn.Softplus(threshold=5)])
def test_other_options_of_an_activation_than_torchs_defaults(activation: nn.Module) -> None:
    reason = reason_kernels_are_off(make_policy(activation_fn=lambda: activation))
    assert reason == f"activation {activation} has other options than torch's defaults"


def test_what_a_policy_is_made_of() -> None:
    known = ", ".join(activation.__name__ for activation in KNOWN)
    reason = reason_kernels_are_off(make_policy(activation_fn=nn.Softsign))
    assert reason == f"activation Softsign is not among {known}"
    reason = reason_kernels_are_off(make_policy(net_arch={"pi": [8], "vf": []}))
    assert reason == "for the critic, a network has no hidden layers"
    assert reason_kernels_are_off(make_policy(net_arch={"pi": [], "vf": [8]})) == (
        "a network has no hidden layers"
    )


@pytest.mark.usefixtures("no_kernels")
def test_kernels_that_are_switched_off() -> None:
    assert reason_kernels_are_off(make_policy()) == "SB3_POLICYFLOW_KERNELS is 0"


def test_kernels_come_back_when_the_reason_is_gone() -> None:
    policy = make_policy()
    handle = policy.velocity.hidden[1].register_forward_hook(lambda *_: None)
    assert reason_kernels_are_off(policy) is not None
    handle.remove()
    assert reason_kernels_are_off(policy) is None
    policy.double()
    assert reason_kernels_are_off(policy) is not None
    policy.float()
    assert reason_kernels_are_off(policy) is None


def test_autocast_and_transformations_are_no_lasting_reasons() -> None:
    policy = make_policy()
    with th.autocast("cpu", th.bfloat16):
        assert "autocast" in str(reason_kernels_are_off(policy))
    assert reason_kernels_are_off(policy) is None
