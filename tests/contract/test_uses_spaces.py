"""Wrappers around single environments, unusual spaces, and options of policies in use."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces, wrappers
from stable_baselines3 import PPO
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecExtractDictObs,
    VecFrameStack,
    VecNormalize,
)
from torch import nn

from sb3_policyflow import DPPO, PolicyFlow
from tests.contract.uses import Steps, make
from tests.helpers import assert_trained, weights


def train(model: Any, total_timesteps: int = 48) -> Any:
    before = weights(model)
    model.learn(total_timesteps)
    assert_trained(model, before)
    return model


# Wrappers around single environments


class Delayed(gym.ActionWrapper[Any, Any, Any]):
    """Acts with the action of the step before."""

    last = np.zeros(2, np.float32)

    def action(self, action: Any) -> Any:
        self.last, delayed = action, self.last
        return delayed


class WithTime(gym.ObservationWrapper[Any, Any, Any]):
    """Appends the time, as TimeFeatureWrapper of rl_zoo3 does."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(-1, 1, (4,))

    def observation(self, observation: Any) -> Any:
        return np.append(observation, self.unwrapped.time / 5).astype(np.float32)  # type: ignore[attr-defined]


WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(-0.5), np.float32(0.5)),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "FrameStack": lambda env: wrappers.FrameStackObservation(env, 3),
    "Flatten": wrappers.FlattenObservation,
    "TimeAware": lambda env: wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 4)),
    "float16": lambda env: wrappers.DtypeObservation(env, np.float16),
    "Sticky": lambda env: wrappers.StickyAction(env, 0.3),
    "MaxAndSkip": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "Delayed": Delayed,
    "WithTime": WithTime,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 3),
}


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_wrappers_of_gymnasium(any_algorithm: type[Any], wrapper: str) -> None:
    train(make(any_algorithm, DummyVecEnv([lambda: WRAPPERS[wrapper](Steps())] * 2)))


def test_clip_action_is_refused(any_algorithm: type[Any]) -> None:
    """It makes bounds infinite, which SB3 refuses."""
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        make(any_algorithm, wrappers.ClipAction(Steps()))


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: VecExtractDictObs(env, "vec"),
        lambda env: VecFrameStack(VecExtractDictObs(env, "vec"), 2),
        lambda env: VecNormalize(VecExtractDictObs(env, "vec")),
        lambda env: VecNormalize(env, norm_obs_keys=["vec"]),
    ],
)
def test_vec_wrappers_of_dictionaries(any_algorithm: type[Any], wrap: Any) -> None:
    env = wrap(DummyVecEnv([lambda: SimpleMultiObsEnv(discrete_actions=False)]))
    is_dict = isinstance(env.observation_space, spaces.Dict)
    kwargs = {"features_extractor_kwargs": {"cnn_output_dim": 4}} if is_dict else {}
    policy = "MultiInputPolicy" if is_dict else "MlpPolicy"
    train(make(any_algorithm, env, policy, policy_kwargs=kwargs))


# Spaces and what does not fit them


class Returning(gym.Env[Any, Any]):
    """Returns observations and takes actions of other kinds than usual."""

    def __init__(self, observe: Any, observation_space: Any = None, action_space: Any = None):
        self.observe = observe
        self.observation_space = observation_space or spaces.Box(-1, 1, (3,))
        self.action_space = action_space or spaces.Box(-1, 1, (2,))
        self.time = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.time = 0
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        assert np.shape(action) == self.action_space.shape
        return self.observe(), 1.0, False, self.time == 5, {}


OBSERVED = np.array([0.1, 0.2, 0.3], np.float32)


@pytest.mark.parametrize(
    "observe",
    [lambda: OBSERVED.tolist(), lambda: tuple(OBSERVED), lambda: OBSERVED.astype(np.float64)],
)
def test_observations_as_lists(any_algorithm: type[Any], observe: Any) -> None:
    model = train(make(any_algorithm, Returning(observe)))
    np.testing.assert_allclose(model.rollout_buffer.observations.reshape(-1, 3)[0], OBSERVED)


def test_observations_with_one_row(any_algorithm: type[Any]) -> None:
    """Shape (1, 3) for a Box of shape (3,)."""
    train(make(any_algorithm, Returning(lambda: OBSERVED[None])))


def test_key_that_the_space_lacks(any_algorithm: type[Any]) -> None:
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,))})
    calls = iter(range(1000))

    def observe() -> Any:
        return {"a": OBSERVED, **({} if next(calls) < 3 else {"b": OBSERVED})}

    env = Simulated(space, observe)
    with pytest.raises(KeyError if any_algorithm is PPO else (KeyError, ValueError)) as caught:
        make(any_algorithm, env, "MultiInputPolicy").learn(48)
    assert "b" in str(caught.value)
    assert "None" not in str(caught.value)


class Simulated(DummyVecEnv):
    """Hands on the dictionaries that it is given."""

    def __init__(self, space: Any, observe: Any) -> None:
        super().__init__([lambda: Returning(lambda: {"a": OBSERVED}, space)])
        self.look = observe

    def _obs_from_buf(self) -> Any:
        return {key: value[None] for key, value in self.look().items()}


@pytest.mark.parametrize(
    "action_space",
    [spaces.Box(-1, 1, ()), spaces.Box(-1, 1, (1, 1)), spaces.Box(-1, 1, (2,), float)],
)
def test_shapes_of_actions(any_algorithm: type[Any], action_space: Any) -> None:
    env = Returning(lambda: OBSERVED, action_space=action_space)
    model = train(make(any_algorithm, env))
    action, _ = model.predict(OBSERVED)
    assert action.shape == action_space.shape


def test_empty_observations_are_refused(any_algorithm: type[Any]) -> None:
    """By SB3's extractor."""
    space = spaces.Box(-1, 1, (0,))
    env = Returning(lambda: np.zeros(0, np.float32), observation_space=space)
    with pytest.raises(AssertionError):
        make(any_algorithm, env)


@pytest.mark.parametrize("bound", [100.0, 1e10])
def test_bounds_that_stand_for_none(any_algorithm: type[Any], bound: float) -> None:
    """Actions stay small enough to be used."""
    env = Returning(lambda: OBSERVED, action_space=spaces.Box(-bound, bound, (2,)))
    model = train(
        make(any_algorithm, env, **({"process": "flow"} if any_algorithm is DPPO else {}))
    )
    assert np.abs(model.predict(np.tile(OBSERVED, (100, 1)))[0]).max() < 20


@pytest.mark.parametrize("bound", [100.0, 1e10])
def test_dppo_warns_of_bounds_that_mean_nothing(bound: float) -> None:
    """It scales its actions to them."""
    env = Returning(lambda: OBSERVED, action_space=spaces.Box(-bound, bound, (2,)))
    with pytest.warns(UserWarning, match="bounds"):
        make(DPPO, env)


def test_dppo_refuses_bounds_that_it_cannot_scale_to() -> None:
    bound = np.finfo(np.float32).max
    env = Returning(lambda: OBSERVED, action_space=spaces.Box(-bound, bound, (2,)))
    with pytest.raises(ValueError, match="use process='flow'"):
        make(DPPO, env)


class Filled(FlattenExtractor):
    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(th.nan_to_num(observations))


def test_missing_readings(any_algorithm: type[Any]) -> None:
    """NaN that the extractor fills in: PPO trains; ours refuse them, as docs/trust.md says."""
    env = Returning(lambda: np.where(np.arange(3) == 0, np.nan, OBSERVED).astype(np.float32))
    model = make(any_algorithm, env, policy_kwargs={"features_extractor_class": Filled})
    if any_algorithm is PPO:
        train(model)
        return
    with pytest.raises(FloatingPointError, match="not finite"):
        model.learn(48)


# Options of policies


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"net_arch": [{"pi": [8], "vf": [8]}]},
        {"net_arch": {"pi": [8, 8], "vf": [4]}},
        {"net_arch": (8, 8)},
        {"activation_fn": nn.PReLU},
        {"activation_fn": nn.SiLU},
        {"ortho_init": False},
        {"optimizer_class": th.optim.SGD},
        {"optimizer_class": th.optim.NAdam},
        {"optimizer_kwargs": {"amsgrad": True}},
        {"optimizer_kwargs": {"eps": 1e-7, "weight_decay": 1e-4}},
        {"share_features_extractor": False},
    ],
    ids=str,
)
def test_policy_kwargs_of_users_files(any_algorithm: type[Any], policy_kwargs: Any) -> None:
    train(make(any_algorithm, policy_kwargs=policy_kwargs))


@pytest.mark.parametrize("name", ["squash_output", "full_std", "use_expln", "log_std_init"])
def test_options_that_only_gaussian_policies_have(algorithm: type[Any], name: str) -> None:
    """Taken where they mean something, or refused by a sentence that names them."""
    value = -1.0 if name == "log_std_init" else True
    if algorithm is PolicyFlow and name == "log_std_init":
        assert make(algorithm, policy_kwargs={name: value}).policy.log_std.mean() == value
        return
    with pytest.raises(TypeError, match=rf"has no {name}: .*flow polic|only PolicyFlow"):
        make(algorithm, policy_kwargs={name: value})


class Networks(nn.Module):
    """Networks of one's own, as SB3 documents them."""

    def __init__(self, n_features: int) -> None:
        super().__init__()
        self.latent_dim_pi = self.latent_dim_vf = 16
        self.pi, self.vf, self.calls = nn.Linear(n_features, 16), nn.Linear(n_features, 16), 0

    def forward(self, x: th.Tensor) -> Any:
        return self.forward_actor(x), self.forward_critic(x)

    def forward_critic(self, x: th.Tensor) -> th.Tensor:
        return self.vf(x).tanh()

    def forward_actor(self, x: th.Tensor) -> th.Tensor:
        self.calls += 1
        return self.pi(x).tanh()


def test_networks_of_ones_own(any_algorithm: type[Any]) -> None:
    """An actor's network is used, or refused with where it goes; a critic's is used."""

    def build(policy: Any) -> None:
        policy.mlp_extractor = Networks(policy.features_dim)

    base = any_algorithm.policy_aliases["MlpPolicy"]
    own = type("Own", (base,), {"_build_mlp_extractor": build})
    try:
        model = make(any_algorithm, None, own).learn(32)
    except (ValueError, NotImplementedError, TypeError) as refusal:
        assert any_algorithm is not PPO
        assert len(str(refusal).split()) > 6  # noqa: PT017
        return
    assert model.policy.mlp_extractor.calls > 0
