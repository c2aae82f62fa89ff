"""SB3's contract for spaces, policies and modes; the tests have the names of SB3's own."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from sb3_policyflow import PolicyFlow
from tests.helpers import SMALL, TINY, train, weights


class DummyEnv(gym.Env[Any, Any]):
    """Random observations from any space; actions must lie in theirs."""

    def __init__(self, observation_space: Any = None, action_space: Any = None) -> None:
        self.observation_space = observation_space or spaces.Box(-1, 1, (2,))
        self.action_space = action_space or spaces.Box(-1, 1, (2,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(np.asarray(action, dtype=self.action_space.dtype))
        return self.observation_space.sample(), 0.0, False, bool(np.random.rand() < 0.1), {}


# Spaces


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        spaces.MultiBinary([3, 2]),
        spaces.Box(-1, 1, (2, 3)),
        spaces.Box(-np.inf, np.inf, (3,)),
        spaces.Box(0, np.inf, (3,)),
        spaces.Box(-1, 1, (3,), np.float64),
        spaces.Box(-1, 1, (3,), np.float16),
        spaces.Box(-5, 5, (3,), np.int8),
        spaces.Box(0, 255, (3,), np.uint8),
    ],
    ids=str,
)
def test_identity_spaces(algorithm: type[Any], space: spaces.Space[Any]) -> None:
    """Observations of every kind."""
    env = DummyEnv(space)
    check_env(env, warn=False)
    model = algorithm("MlpPolicy", env, policy_kwargs=TINY, **SMALL).learn(32)
    assert th.isfinite(weights(model)).all()
    mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)
    assert mean == 0.0


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (1,)),
        spaces.Box(-1, 1, (2, 1, 3)),
        spaces.Box(-2, 1, (2,), np.float64),
        spaces.Box(np.array([-1, 5], np.float32), np.array([0, 100], np.float32)),
        spaces.Box(1, 1, (2,)),
        spaces.Box(-1, 0.001, (2,)),  # where scaling from [-1, 1] rounds upwards
    ],
    ids=str,
)
def test_action_spaces(algorithm: type[Any], space: spaces.Space[Any]) -> None:
    model = algorithm("MlpPolicy", DummyEnv(None, space), policy_kwargs=TINY, **SMALL).learn(32)
    with th.no_grad():
        model.policy.velocity.output.bias.fill_(-100.0 if model.policy.squash_output else 100.0)
    for deterministic in (True, False):
        action, state = model.predict(model.observation_space.sample(), deterministic=deterministic)
        assert space.contains(action.astype(space.dtype))
        assert state is None


@pytest.mark.parametrize("bounds", [(-np.inf, np.inf), (0, np.inf), (-np.inf, 0)])
def test_unbounded_actions_are_refused(algorithm: type[Any], bounds: tuple[float, float]) -> None:
    """As by PPO: SB3 wants bounds to clip to, and says so."""
    with pytest.raises(AssertionError, match="must have a finite lower and upper bound"):
        algorithm("MlpPolicy", DummyEnv(None, spaces.Box(*bounds, (2,))))


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3, start=1), spaces.MultiDiscrete([2], start=[1])]
)
def test_discrete_spaces_that_do_not_count_from_0(
    algorithm: type[Any], space: spaces.Space[Any]
) -> None:
    for policy, observations in (("MlpPolicy", space), ("MultiInputPolicy", {"a": space})):
        whole = spaces.Dict(observations) if isinstance(observations, dict) else observations
        with pytest.raises(ValueError, match="must count from 0, as SB3 encodes them"):
            algorithm(policy, DummyEnv(whole))


def test_float64_action_space(algorithm: type[Any]) -> None:
    env = DummyEnv(spaces.Box(-1, 1, (1,), np.float64), spaces.Box(-1, 1, (1,), np.float64))
    model = algorithm("MlpPolicy", env, policy_kwargs=TINY, **SMALL).learn(16)
    action, _ = model.predict(env.observation_space.sample(), deterministic=True)
    assert action.dtype == np.float64 or env.action_space.contains(action.astype(np.float64))


# Dictionaries and images


@pytest.mark.parametrize("channel_last", [False, True])
def test_dict_spaces(algorithm: type[Any], channel_last: bool) -> None:
    shape = (36, 36, 3) if channel_last else (3, 36, 36)
    parts: dict[str, spaces.Space[Any]] = {
        "img": spaces.Box(0, 255, shape, np.uint8),
        "vec": spaces.Box(-1, 1, (2,)),
        "discrete": spaces.Discrete(4),
    }
    space = spaces.Dict(parts)
    kwargs = {**TINY, "features_extractor_kwargs": {"cnn_output_dim": 4}}
    env = make_vec_env(lambda: DummyEnv(space), 2)
    model = algorithm("MultiInputPolicy", env, policy_kwargs=kwargs, **SMALL).learn(32)
    evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)
    assert model.predict(space.sample())[0].shape == (2,)


def test_consistency(algorithm: type[Any]) -> None:
    """The same numbers, in a dictionary or not, train the same weights."""

    class AsDict(gym.ObservationWrapper[Any, Any, Any]):
        def __init__(self, env: gym.Env[Any, Any]) -> None:
            super().__init__(env)
            self.observation_space = spaces.Dict({"obs": env.observation_space})

        def observation(self, observation: Any) -> Any:
            return {"obs": observation}

    def train(policy: str, wrap: Any) -> th.Tensor:
        env = make_vec_env("Pendulum-v1", seed=0, wrapper_class=wrap)
        model = algorithm(policy, env, policy_kwargs=TINY, **SMALL)
        return weights(model.learn(48))

    assert th.equal(train("MlpPolicy", None), train("MultiInputPolicy", AsDict))


def test_dict_nested() -> None:
    nested = spaces.Dict({"inner": spaces.Dict({"x": spaces.Box(-1, 1, (2,))})})
    with pytest.raises(NotImplementedError, match="Nested observation spaces are not supported"):
        PolicyFlow("MultiInputPolicy", DummyEnv(nested))


def test_dict_vec_framestack(algorithm: type[Any]) -> None:
    env: Any = DummyVecEnv([lambda: SimpleMultiObsEnv(random_start=True, discrete_actions=False)])
    order: Any = {"vec": None, "img": "last"}
    env = VecFrameStack(env, n_stack=3, channels_order=order)
    kwargs = {**TINY, "features_extractor_kwargs": {"cnn_output_dim": 4}}
    model = train(algorithm("MultiInputPolicy", env, policy_kwargs=kwargs, **SMALL), 32)
    observation = model.get_env().reset()
    assert observation["vec"].shape == (1, 3 * 5)
    assert observation["img"].shape == (1, 3, 64, 64)
    actions, _ = model.predict(observation)
    assert actions.shape == (1, *env.action_space.shape)
    assert np.isfinite(evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)[0])


def test_multiprocessing() -> None:
    def make() -> gym.Env[Any, Any]:
        return SimpleMultiObsEnv(discrete_actions=False)

    env = make_vec_env(make, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"})
    train(PolicyFlow("MultiInputPolicy", env, policy_kwargs=TINY, **SMALL), 32)
    env.close()


def test_vec_transpose_skip() -> None:
    """Images with their channels first are left as they are, those with channels last turned."""
    for shape, turned in (((3, 40, 40), False), ((40, 40, 3), True)):
        space = spaces.Box(0, 255, shape, np.uint8)
        kwargs = {**TINY, "features_extractor_kwargs": {"features_dim": 8}}
        model = PolicyFlow("CnnPolicy", DummyEnv(space), policy_kwargs=kwargs, **SMALL).learn(16)
        assert isinstance(model.get_env(), VecTransposeImage) is turned
        assert model.predict(space.sample())[0].shape == (2,)


def test_image_space_checks() -> None:
    with pytest.raises(AssertionError, match="NatureCNN"):
        PolicyFlow("CnnPolicy", DummyEnv())


# Policies


@pytest.mark.parametrize(
    "net_arch",
    [[], [4], [4, 4], {"vf": [16], "pi": [8]}, {"vf": [8, 4], "pi": [8]}, {"vf": [8]}, {"pi": [8]}],
    ids=str,
)
def test_flexible_mlp(algorithm: type[Any], net_arch: Any) -> None:
    """The layers are those that were asked for, and they learn."""
    model = algorithm("MlpPolicy", DummyEnv(), policy_kwargs={"net_arch": net_arch}, **SMALL)
    train(model, 16)
    sizes = net_arch if isinstance(net_arch, dict) else {"pi": net_arch, "vf": net_arch}
    for key, layers in (
        ("pi", model.policy.velocity.hidden),
        ("vf", model.policy.mlp_extractor.value_net),
    ):
        found = [layer.out_features for layer in layers if isinstance(layer, th.nn.Linear)]
        assert found == sizes.get(key, [])


@pytest.mark.parametrize(
    "optimizer", [(th.optim.AdamW, {"weight_decay": 0.01}), (RMSpropTFLike, {"eps": 1e-5})]
)
def test_custom_optimizer(algorithm: type[Any], optimizer: tuple[Any, dict[str, Any]]) -> None:
    kind, options = optimizer
    kwargs = {"optimizer_class": kind, "optimizer_kwargs": options, **TINY}
    model = algorithm("MlpPolicy", DummyEnv(), policy_kwargs=kwargs, **SMALL).learn(16)
    assert isinstance(model.policy.optimizer, kind)
    for name, value in options.items():
        assert model.policy.optimizer.param_groups[0][name] == value


# Constructing and repeating


def test_no_warnings_on_construction(algorithm: type[Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        algorithm("MlpPolicy", "Pendulum-v1")
        algorithm("MlpFlowPolicy", make_vec_env("Pendulum-v1", 4), n_steps=16, device="cpu")


def test_deterministic_training_common(algorithm: type[Any]) -> None:
    results = []
    for _ in range(2):
        env = IdentityEnvBox(-10, 10)
        model = algorithm("MlpPolicy", env, policy_kwargs=TINY, **SMALL).learn(64)
        rewards = evaluate_policy(model, model.get_env(), 3, deterministic=False, warn=False)
        results.append((weights(model), rewards))
    assert th.equal(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]


def test_auto_wrap(algorithm: type[Any]) -> None:
    with pytest.raises(ValueError, match="needs an environment to know its spaces"):
        algorithm("MlpPolicy", None)
    assert isinstance(algorithm("MlpPolicy", "Pendulum-v1").get_env(), DummyVecEnv)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_predict(algorithm: type[Any], n_envs: int) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs))
    model = algorithm("MlpPolicy", env, policy_kwargs=TINY, **SMALL)
    obs: Any = env.reset()
    actions, _ = model.predict(obs)
    assert actions.shape == (n_envs, 1)
    assert model.predict(obs[0])[0].shape == (1,)
    wrong = np.zeros((n_envs, 7), np.float32)
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(wrong)
    tensor = model.policy.obs_to_tensor(obs)[0]
    with th.no_grad():
        sampled, values, record = model.policy(tensor)
    assert (sampled.shape, values.shape) == ((n_envs, 1), (n_envs, 1))
    assert hasattr(record, "_fields")
