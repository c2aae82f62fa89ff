"""SB3's contract for files and parameters; the tests have the names of SB3's own."""

import importlib
import io
import pathlib
import sys
import warnings
from collections import OrderedDict
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_policyflow import PolicyFlow
from tests.helpers import SMALL, TINY, train, weights


def identity() -> DummyVecEnv:
    return DummyVecEnv([lambda: IdentityEnvBox(-10, 10)])


def make(algorithm: type[Any], **options: Any) -> Any:
    return algorithm("MlpPolicy", identity(), **{**SMALL, "policy_kwargs": TINY, **options})


def test_save_load(algorithm: type[Any], tmp_path: Path) -> None:
    model = make(algorithm, seed=1).learn(32)
    env = model.get_env()
    observations = np.concatenate([env.step([env.action_space.sample()])[0] for _ in range(10)])

    params = deepcopy(model.policy.state_dict())
    model.policy.load_state_dict(OrderedDict((k, th.rand_like(v)) for k, v in params.items()))
    randomised = model.policy.state_dict()
    assert not all(th.equal(params[key], randomised[key]) for key in params)

    new_params = model.policy.state_dict()
    selected, _ = model.predict(observations, deterministic=True)
    model.save(tmp_path / "test_save.zip")
    del model

    for device in ("cpu", "auto"):
        model = algorithm.load(tmp_path / "test_save.zip", env=env, device=device)
        for key, value in model.policy.state_dict().items():
            assert th.equal(value, new_params[key])
        new_selected, _ = model.predict(observations, deterministic=True)
        np.testing.assert_allclose(selected, new_selected, 1e-4)
    train(model, 32)

    with pytest.raises(ValueError, match="specified policy kwargs do not equal"):
        algorithm.load(tmp_path / "test_save.zip", policy_kwargs={"net_arch": [16]})


def count_resets(env: DummyVecEnv) -> list[int]:
    """A list that grows by one with each reset from outside."""
    resets: list[int] = []
    reset = env.reset

    def counted() -> Any:
        resets.append(1)
        return reset()

    env.reset = counted  # type: ignore[method-assign]
    return resets


def test_set_env(algorithm: type[Any], tmp_path: Path) -> None:
    env, other, third = identity(), identity(), IdentityEnvBox(-10, 10)
    model = make(algorithm, seed=1)
    model.set_env(env)
    train(model, 32)
    resets = count_resets(other)
    model.set_env(other, force_reset=False)
    train(model, 16, reset_num_timesteps=False)
    assert len(resets) == 0
    model.set_env(other)
    train(model, 16, reset_num_timesteps=False)
    assert len(resets) == 1
    model.set_env(third)
    train(model, 16)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(make_vec_env(lambda: IdentityEnvBox(-10, 10), 2))
    with pytest.raises(ValueError, match="spaces do not match"):
        model.set_env(make_vec_env("Pendulum-v1"))


def test_load_with_another_number_of_environments(algorithm: type[Any], tmp_path: Path) -> None:
    make(algorithm).learn(16).save(tmp_path / "model")
    env = make_vec_env(lambda: IdentityEnvBox(-10, 10), 3)
    loaded = algorithm.load(tmp_path / "model", env=env)
    assert loaded.learn(48).num_timesteps == 48
    with pytest.raises(ValueError, match="spaces do not match"):
        algorithm.load(tmp_path / "model", env=make_vec_env("Pendulum-v1"))


def test_exclude_include_saved_params(algorithm: type[Any], tmp_path: Path) -> None:
    model = make(algorithm, verbose=2)
    model.save(tmp_path / "test_save", exclude=["verbose"])
    assert algorithm.load(str(tmp_path / "test_save.zip")).verbose == 0
    model.save(tmp_path / "test_save", exclude=["verbose"], include=["verbose"])
    assert algorithm.load(tmp_path / "test_save").verbose == 2


def test_custom_objects(algorithm: type[Any], tmp_path: Path) -> None:
    make(algorithm, learning_rate=1e-3).save(tmp_path / "model")
    changed = {"learning_rate": 5e-4, "clip_range": 0.1}
    loaded = algorithm.load(tmp_path / "model", custom_objects=changed)
    assert (loaded.learning_rate, loaded.clip_range(1.0)) == (5e-4, 0.1)


def test_get_and_set_parameters(algorithm: type[Any], tmp_path: Path) -> None:
    model, other = make(algorithm).learn(16), make(algorithm)
    parameters = model.get_parameters()
    assert set(parameters) == {"policy", "policy.optimizer"}
    other.set_parameters(parameters)
    assert th.equal(weights(model), weights(other))
    model.save(tmp_path / "model")
    third = make(algorithm)
    third.set_parameters(str(tmp_path / "model"))
    assert th.equal(weights(model), weights(third))
    with pytest.raises(ValueError, match="Names of parameters do not match"):
        other.set_parameters({"policy": parameters["policy"]})
    other.set_parameters({"policy": parameters["policy"]}, exact_match=False)
    with pytest.raises(ValueError, match="invalid object name"):
        other.set_parameters({"critic": parameters["policy"]})


def test_save_load_env_cnn(algorithm: type[Any], tmp_path: Path) -> None:
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=2, discrete=False)
    options = {**SMALL, "policy_kwargs": {"features_extractor_kwargs": {"features_dim": 8}}}
    saved = algorithm("CnnPolicy", env, **options).learn(16)
    saved.save(tmp_path / "test_save")
    model = algorithm.load(tmp_path / "test_save", env=env)
    assert th.equal(weights(model), weights(saved))
    train(model, 16)


@pytest.mark.parametrize("policy_str", ["MlpPolicy", "CnnPolicy"])
def test_save_load_policy(algorithm: type[Any], policy_str: str, tmp_path: Path) -> None:
    options = SMALL
    env: Any = IdentityEnvBox(-10, 10)
    if policy_str == "CnnPolicy":
        env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=2, discrete=False)
        options = {**SMALL, "policy_kwargs": {"features_extractor_kwargs": {"features_dim": 8}}}
    model = algorithm(policy_str, env, **options).learn(16)
    obs = np.stack([model.observation_space.sample() for _ in range(4)])
    expected, _ = model.policy.predict(obs, deterministic=True)
    model.policy.save(tmp_path / "policy.pkl")
    loaded = type(model.policy).load(tmp_path / "policy.pkl")
    np.testing.assert_allclose(loaded.predict(obs, deterministic=True)[0], expected, 1e-4)


@pytest.mark.parametrize("pathtype", [str, pathlib.Path])
def test_open_file_str_pathlib(pathtype: type[Any], tmp_path: Path) -> None:
    model = make(PolicyFlow)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.save(pathtype(tmp_path / "t1"))
        model.save(pathtype(tmp_path / "t1"))
        model.save(pathtype(tmp_path / "t2.model"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t1.zip", "t2.model"]
    for name in ("t1", "t2.model"):
        assert th.equal(weights(PolicyFlow.load(pathtype(tmp_path / name))), weights(model))


def test_open_file(tmp_path: Path) -> None:
    model = make(PolicyFlow)
    buffer = io.BytesIO()
    buffer.close()
    with pytest.raises(ValueError, match="closed"):
        model.save(buffer)
    with open(tmp_path / "text", "w+") as text:
        as_text: Any = text
        with pytest.raises(TypeError, match="invalid type"):
            model.save(as_text)
        with pytest.raises(TypeError, match="invalid type"):
            PolicyFlow.load(as_text)


def test_save_load_large_model(algorithm: type[Any], tmp_path: Path) -> None:
    """More than the 2 GB of an old zip would take minutes; 30 MB go the same way."""
    options = {**SMALL, "policy_kwargs": {"net_arch": [1024, 1024]}}
    model = algorithm("MlpPolicy", identity(), **options)
    model.save(tmp_path / "test_save")
    assert th.equal(weights(algorithm.load(tmp_path / "test_save")), weights(model))
    (tmp_path / "test_save.zip").unlink()


def test_load_invalid_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What can no longer be read can be given in its place."""
    (tmp_path / "of_yesterday.py").write_text("def rate(progress):\n    return 1e-3\n")
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        rate = importlib.import_module("of_yesterday").rate
        make(PolicyFlow, learning_rate=rate).save(tmp_path / "model")
        del sys.modules["of_yesterday"]
    with pytest.raises(ModuleNotFoundError, match="of_yesterday"):
        PolicyFlow.load(tmp_path / "model")
    given = {"learning_rate": 1e-4, "lr_schedule": FloatSchedule(1e-4)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = PolicyFlow.load(tmp_path / "model", custom_objects=given)
    assert loaded.learning_rate == 1e-4


def test_no_resource_warning(tmp_path: Path) -> None:
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        model = make(PolicyFlow)
        model.save(tmp_path / "model")
        PolicyFlow.load(tmp_path / "model")
    assert len(record) == 0


def test_cast_lr_schedule(tmp_path: Path) -> None:
    """numpy's floats in schedules do not stop files from loading."""
    model = make(PolicyFlow, learning_rate=lambda progress: float(np.float32(1e-3) * progress))
    model.learn(16)
    model.save(tmp_path / "model")
    assert PolicyFlow.load(tmp_path / "model").lr_schedule(1.0) == pytest.approx(1e-3)


def test_save_load_net_arch_none(algorithm: type[Any], tmp_path: Path) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": None})
    model.save(tmp_path / "m")
    loaded = algorithm.load(tmp_path / "m")
    assert th.equal(weights(loaded), weights(model))
    observation = model.observation_space.sample()
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)


def test_save_load_clip_range_portable(algorithm: type[Any], tmp_path: Path) -> None:
    make(algorithm, clip_range=0.3, clip_range_vf=0.4).save(tmp_path / "m")
    loaded = algorithm.load(tmp_path / "m")
    assert (loaded.clip_range(0.5), loaded.clip_range_vf(0.5)) == (0.3, 0.4)


@pytest.mark.slow
def test_compiled_policy(algorithm: type[Any], tmp_path: Path) -> None:
    model = make(algorithm, seed=0)
    model.policy = th.compile(model.policy, backend="eager")  # others take minutes
    model.learn(16)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=identity())
    assert th.equal(weights(loaded), weights(model))
    train(loaded, 16)
