"""What SB3 lets its users give to, override in and read from a policy has an effect or a reason.

The tables are complete: a name that SB3 adds makes a test fail until it is decided on.
"""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.buffers import FlowRolloutBuffer
from tests.helpers import SMALL, TINY, train, weights


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
    "use_sde": (True, "use_sde is an option of the algorithm"),
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


@pytest.mark.parametrize("build", [own_networks, deeper])
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


def test_buffers_of_sb3_are_refused_with_a_sentence(algorithm: type[Any]) -> None:
    with pytest.raises(ValueError, match="needs a rollout buffer that stores"):
        make(algorithm, rollout_buffer_class=RolloutBuffer)


@pytest.mark.parametrize(
    ("algorithm", "options", "message"),
    [
        (PolicyFlow, {"activation_fn": nn.ReLU}, r"give it in policy_kwargs, as PolicyFlow\("),
        (DPPO, {"net_arch": [8]}, r"policy_kwargs=dict\(net_arch=\.\.\.\)"),
        (PolicyFlow, {"initialisation": "zero"}, "did you mean initialization in policy_kwargs"),
        (FPO, {"log_std_init": -1.0}, "FPO has no log_std_init: only PolicyFlow"),
        (PolicyFlow, {"full_std": True}, "PolicyFlow has no full_std: it belongs to gSDE"),
        (FPO, {"lerning_rate": 1e-3}, "FPO has no argument 'lerning_rate': did you mean learning_"),
        (PolicyFlow, {"brownian": 0.1}, "did you mean brownian_"),
        (DPPO, {"denoising_steps": 5}, "did you mean n_denoising_steps"),
        (PolicyFlow, {"xyz": 1}, r"'xyz': help\(PolicyFlow\) shows those it has"),
        (FPO, {"policy_kwargs": {"net_arh": []}}, "FPOPolicy has no argument 'net_arh': did you"),
        (PolicyFlow, {"policy_kwargs": {"n_step": 5}}, "PolicyFlowPolicy has no argument"),
        (
            PolicyFlow,
            {"policy_kwargs": {"brownian_coef": 0.1}},
            r"not of its policy: take it out of policy_kwargs, as PolicyFlow\(\.\.\., brown",
        ),
    ],
    ids=str,
)
def test_arguments_that_do_not_exist(
    algorithm: type[Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=message):
        algorithm("MlpPolicy", "Pendulum-v1", **{**SMALL, **options})


def test_arguments_of_a_policy_of_ones_own() -> None:
    base = PolicyFlow.policy_aliases["MlpPolicy"]

    class Own(base):  # type: ignore[misc,valid-type]
        def __init__(self, *args: Any, scale: float = 1.0, **kwargs: Any) -> None:
            self.scale = scale
            super().__init__(*args, **kwargs)

    assert make(PolicyFlow, Own, policy_kwargs={**TINY, "scale": 2.0}).policy.scale == 2.0
    with pytest.raises(TypeError, match=r"scale is an option of PolicyFlow's policy: give it in"):
        make(PolicyFlow, Own, scale=2.0)
    with pytest.raises(TypeError, match=r"Own has no argument 'scal': did you mean scale"):
        make(PolicyFlow, Own, policy_kwargs={**TINY, "scal": 2.0})
