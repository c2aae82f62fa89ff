"""What SB3 lets its users give to, override in and read from a policy has an effect or a reason.

The tables are complete: a name that SB3 adds makes a test fail until it is decided on.
"""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_policyflow import PolicyFlow
from sb3_policyflow.common.buffers import FlowRolloutBuffer
from tests.helpers import SMALL, TINY


def make(algorithm: type[Any], policy: Any = "MlpPolicy", **options: Any) -> Any:
    return algorithm(policy, "Pendulum-v1", **{**SMALL, "policy_kwargs": TINY, **options})


# Arguments


class Padded(FlattenExtractor):
    """Features with zeros behind them."""

    def __init__(self, observation_space: gym.Space[Any], n_zeros: int = 1) -> None:
        super().__init__(observation_space)
        self._features_dim += n_zeros

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = super().forward(observations)
        return nn.functional.pad(features, (0, self.features_dim - features.shape[1]))


POLICY_ARGUMENTS: dict[str, tuple[Any, str | Callable[[Any], bool]]] = {
    "net_arch": ([5], lambda p: p.velocity.output.in_features == 5 == p.value_net.in_features),
    "activation_fn": (nn.ReLU, lambda p: type(p.mlp_extractor.value_net[1]) is nn.ReLU),
    "ortho_init": (False, lambda p: bool(p.value_net.bias.any())),
    "use_sde": (True, "use_sde: it belongs to gSDE"),
    "log_std_init": (-1.0, "has no log_std_init: only PolicyFlow"),
    "full_std": (False, "full_std: it belongs to gSDE"),
    "use_expln": (True, "use_expln: it belongs to gSDE"),
    "squash_output": (True, "squash_output: it belongs to gSDE.* process='ddpm'"),
    "features_extractor_class": (Padded, lambda p: p.features_dim == 4),
    "features_extractor_kwargs": ({"n_zeros": 3}, lambda p: p.features_dim == 6),
    "share_features_extractor": (
        False,
        lambda p: p.pi_features_extractor is not p.vf_features_extractor,
    ),
    "normalize_images": (False, lambda p: not p.normalize_images),
    "optimizer_class": (th.optim.SGD, lambda p: type(p.optimizer) is th.optim.SGD),
    "optimizer_kwargs": ({"eps": 0.1}, lambda p: p.optimizer.defaults["eps"] == 0.1),
}
"""A value for each argument of SB3's policy, and its effect or the message that refuses it."""


def test_arguments_of_sb3s_policy(algorithm: type[Any]) -> None:
    of_sb3 = inspect.signature(ActorCriticPolicy).parameters.keys()
    assert POLICY_ARGUMENTS.keys() == of_sb3 - {"observation_space", "action_space", "lr_schedule"}
    for name, (value, outcome) in POLICY_ARGUMENTS.items():
        kwargs = {name: value}
        if name == "features_extractor_kwargs":
            kwargs["features_extractor_class"] = Padded
        if name == "log_std_init" and algorithm is PolicyFlow:
            policy = make(algorithm, policy_kwargs=kwargs).policy
            assert th.equal(policy.log_std, th.tensor([-1.0]))
        elif isinstance(outcome, str):
            with pytest.raises((TypeError, ValueError), match=outcome):
                make(algorithm, policy_kwargs=kwargs)
        else:
            assert not outcome(make(algorithm).policy), name
            assert outcome(make(algorithm, policy_kwargs=kwargs).policy), name


class OwnBuffer(FlowRolloutBuffer):
    """A buffer of one's own."""

    def __init__(self, *args: Any, extra: int = 0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.extra = extra


ALGORITHM_ARGUMENTS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "n_steps": 24,
    "batch_size": 4,
    "n_epochs": 3,
    "gamma": 0.9,
    "gae_lambda": 0.8,
    "clip_range": 0.3,
    "clip_range_vf": 0.4,
    "normalize_advantage": False,
    "ent_coef": 0.01,
    "vf_coef": 0.7,
    "max_grad_norm": 0.9,
    "rollout_buffer_class": OwnBuffer,
    "rollout_buffer_kwargs": {"extra": 3},
    "target_kl": 0.2,
    "stats_window_size": 7,
    "tensorboard_log": "logs",
    "policy_kwargs": {"net_arch": [3]},
    "verbose": 1,
    "seed": 5,
    "device": "cpu",
    "_init_setup_model": True,
}
"""A value for each argument of PPO that is used; those of gSDE are refused."""


def test_arguments_of_ppo(algorithm: type[Any]) -> None:
    of_sb3 = inspect.signature(PPO).parameters.keys()
    of_gsde: dict[str, Any] = {"use_sde": True, "sde_sample_freq": 4}
    assert ALGORITHM_ARGUMENTS.keys() | of_gsde.keys() | {"policy", "env"} == of_sb3
    options = dict(ALGORITHM_ARGUMENTS)
    model = algorithm("MlpPolicy", "Pendulum-v1", **options)
    for name in ("clip_range", "clip_range_vf"):
        assert getattr(model, name)(1.0) == options.pop(name)
    assert model._stats_window_size == options.pop("stats_window_size")
    assert (str(model.device), options.pop("device")) == ("cpu", "cpu")
    assert model.rollout_buffer.extra == 3
    assert type(model.rollout_buffer) is OwnBuffer
    del options["_init_setup_model"]
    for name, value in options.items():
        assert getattr(model, name) == value, name
    for name, value in of_gsde.items():
        with pytest.raises(ValueError, match=rf"{name}=.* not support.*leave it out"):
            make(algorithm, **{name: value})


# Methods and attributes


def own(algorithm: type[Any], **methods: Any) -> type[Any]:
    return type("Own", (algorithm.policy_aliases["MlpPolicy"],), methods)


HAVE_AN_EFFECT = {
    "_build",
    "_build_mlp_extractor",
    "_get_constructor_parameters",
    "_predict",
    "extract_features",
    "forward",
    "make_features_extractor",
    "predict_values",
    "set_training_mode",
}
"""Methods of SB3's policies that one may override, and that are called."""
AS_INHERITED = {
    "_dummy_schedule",
    "_update_features_extractor",
    "device",
    "init_weights",
    "is_vectorized_observation",
    "load",
    "load_from_vector",
    "obs_to_tensor",
    "parameters_to_vector",
    "predict",
    "save",
    "scale_action",
    "squash_output",
    "unscale_action",
}
"""What is called by users alone, and by SB3 where it acts."""
REFUSE = {"evaluate_actions", "get_distribution", "reset_noise", "_get_action_dist_from_latent"}
"""What a policy without a likelihood and without gSDE cannot do."""


def test_every_method_of_sb3s_policy_is_decided_on(algorithm: type[Any]) -> None:
    of_sb3 = {name for name in dir(ActorCriticPolicy) if name not in dir(nn.Module)}
    of_sb3 |= {"forward"}
    of_sb3 -= {"__abstractmethods__", "__slots__", "_abc_impl"}
    assert of_sb3 == HAVE_AN_EFFECT | AS_INHERITED | REFUSE
    assert all(hasattr(algorithm.policy_base, name) for name in of_sb3)


@pytest.mark.parametrize("name", ["_get_action_dist_from_latent", "reset_noise"])
def test_methods_that_nothing_calls_are_refused(algorithm: type[Any], name: str) -> None:
    with pytest.raises(TypeError, match=rf"Own overrides {name}, but .*: override sample_actions"):
        make(algorithm, own(algorithm, **{name: lambda *_: None}))


@pytest.mark.parametrize("name", ["evaluate_actions", "get_distribution"])
def test_methods_that_training_does_not_call_are_announced(algorithm: type[Any], name: str) -> None:
    with pytest.warns(UserWarning, match=f"Own overrides {name}, which the flow algorithms do not"):
        make(algorithm, own(algorithm, **{name: lambda *_: "mine"}))


def test_what_a_gaussian_policy_has_is_not_there(algorithm: type[Any]) -> None:
    policy = make(algorithm).policy
    of_ppo = make(PPO, policy_kwargs={"net_arch": [8]}).policy
    missing = {name for name in vars(of_ppo) if not hasattr(policy, name)}
    assert missing == {"action_dist"}
    missing = {name for name in of_ppo._modules if not hasattr(policy, name)}
    assert missing == {"action_net"}
    assert hasattr(policy, "log_std") == (algorithm is PolicyFlow)
    with pytest.raises(TypeError, match="does not support gSDE"):
        policy.reset_noise()


def test_parameters_of_the_actor_are_found_by_their_names(algorithm: type[Any]) -> None:
    """SB3's documentation filters them by "policy" and "action" in the name; see docs/trust.md."""
    model = make(algorithm)
    actor = {name for name in model.get_parameters()["policy"] if "velocity" in name}
    others = {name for name in model.get_parameters()["policy"] if name not in actor}
    of_critic = {id(parameter) for parameter in model.policy.critic_parameters()}
    for name, parameter in model.policy.named_parameters():
        assert (name in others - {"log_std"}) == (id(parameter) in of_critic), name


def test_buffers_of_sb3_are_refused_with_a_sentence(algorithm: type[Any]) -> None:
    with pytest.raises(ValueError, match="needs a rollout buffer that stores"):
        make(algorithm, rollout_buffer_class=RolloutBuffer)
