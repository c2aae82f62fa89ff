"""Files and weights as users move them: other hyperparameters, other models, other places."""

import io
import pathlib
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import FloatSchedule, polyak_update
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.contract.uses import ACTIONS, OBSERVATIONS, learned, make, steps
from tests.helpers import SMALL, weights

pytestmark = pytest.mark.slow

SEEN = np.linspace(-1, 1, 30).reshape(10, 3).astype(np.float32)


def actions(model: Any) -> np.ndarray:
    return np.asarray(model.predict(SEEN, deterministic=True)[0])


# Going on with other hyperparameters


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_steps", 32),
        ("batch_size", 4),
        ("n_epochs", 3),
        ("gamma", 0.5),
        ("gae_lambda", 0.5),
        ("ent_coef", 0.1),
        ("vf_coef", 1.0),
        ("clip_range", 0.05),
        ("learning_rate", 1e-4),
        ("target_kl", 0.1),
        ("max_grad_norm", 0.1),
        ("normalize_advantage", False),
        ("verbose", 1),
        ("tensorboard_log", None),
        ("stats_window_size", 7),
    ],
)
def test_load_with_another_option(
    any_algorithm: type[Any], name: str, value: Any, tmp_path: Path
) -> None:
    """It counts as if it had been given: what PPO goes on with too."""
    learned(any_algorithm).save(tmp_path / "model")
    model = any_algorithm.load(tmp_path / "model", env=steps(), **{name: value})
    model.learn(32, reset_num_timesteps=False)
    found = getattr(model, name)
    assert (found(1.0) if name == "clip_range" else found) == value
    if name in ("gamma", "gae_lambda"):
        assert getattr(model.rollout_buffer, name) == value
    if name == "n_steps":
        assert model.rollout_buffer.buffer_size == value
    if name == "learning_rate":
        assert model.policy.optimizer.param_groups[0]["lr"] == value


@pytest.mark.parametrize(
    ("algorithm", "name", "first", "second"),
    [
        (PolicyFlow, "n_flow_steps", 2, 5),
        (PolicyFlow, "solver", "euler", "rk4"),
        (PolicyFlow, "interpolant", "rectified", "trigflow"),
        (FPO, "n_flow_steps", 2, 5),
        (FPO, "solver", "euler", "rk4"),
        (DPPO, "n_denoising_steps", 3, 6),
    ],
)
def test_load_with_another_option_of_the_policy(
    algorithm: type[Any], name: str, first: Any, second: Any, tmp_path: Path
) -> None:
    model = learned(algorithm, **{name: first})
    model.save(tmp_path / "model")
    same = algorithm.load(tmp_path / "model", env=steps(), **{name: first})
    np.testing.assert_array_equal(actions(same), actions(model))
    other = algorithm.load(tmp_path / "model", env=steps(), **{name: second})
    assert getattr(other.policy, name) == second
    assert np.abs(actions(other) - actions(model)).max() > 1e-6
    other.learn(32)


@pytest.mark.parametrize("name", ["interpolant", "path"])
def test_load_with_all_of_its_hyperparameters(name: str, tmp_path: Path) -> None:
    """As ``rl_zoo3``'s ``-i MODEL.zip`` does; ``path`` is the former name of an option."""
    hyperparameters = {**SMALL, "learning_rate": 1e-3, name: "trigflow"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        model = PolicyFlow("MlpPolicy", steps(), **hyperparameters).learn(32)
        model.save(tmp_path / "model")
        loaded = PolicyFlow.load(tmp_path / "model", env=steps(), **hyperparameters)
    np.testing.assert_array_equal(actions(loaded), actions(model))
    assert loaded.learn(32, reset_num_timesteps=False).num_timesteps == 64


def test_load_with_the_same_policy_kwargs(any_algorithm: type[Any], tmp_path: Path) -> None:
    model = learned(any_algorithm)
    model.save(tmp_path / "model")
    same = any_algorithm.load(tmp_path / "model", policy_kwargs=dict(model.policy_kwargs))
    np.testing.assert_array_equal(actions(same), actions(model))
    with pytest.raises(ValueError, match="policy kwargs"):
        any_algorithm.load(tmp_path / "model", policy_kwargs={"net_arch": [99]})


# From model to model


def copy_vector(source: Any, target: Any) -> None:
    target.policy.load_from_vector(source.policy.parameters_to_vector())


def copy_average(source: Any, target: Any) -> None:
    polyak_update(source.policy.parameters(), target.policy.parameters(), tau=1.0)


def copy_state(source: Any, target: Any) -> None:
    target.policy.load_state_dict(source.policy.state_dict())


def copy_parameters(source: Any, target: Any) -> None:
    target.set_parameters(source.get_parameters())


def copy_one_by_one(source: Any, target: Any) -> None:
    own = dict(target.policy.named_parameters())
    for name, parameter in source.policy.named_parameters():
        own[name].data.copy_(parameter.data)


@pytest.mark.parametrize(
    "copy", [copy_vector, copy_average, copy_state, copy_parameters, copy_one_by_one]
)
def test_copied_weights_make_the_same_policy(any_algorithm: type[Any], copy: Any) -> None:
    source, target = learned(any_algorithm), make(any_algorithm, seed=1)
    assert np.abs(actions(source) - actions(target)).max() > 1e-3
    copy(source, target)
    np.testing.assert_allclose(actions(target), actions(source), atol=1e-6)


def test_average_of_two_models(any_algorithm: type[Any]) -> None:
    """The mean of two runs' weights acts, and trains on."""
    one, other = learned(any_algorithm), learned(any_algorithm, learning_rate=3e-3)
    vectors = [model.policy.parameters_to_vector() for model in (one, other)]
    one.policy.load_from_vector(np.mean(vectors, axis=0))
    assert np.isfinite(actions(one)).all()
    assert th.isfinite(weights(one.learn(32))).all()


# Statistics of VecNormalize


@pytest.mark.parametrize("n_envs", [1, 3])
def test_normalized_run_is_played_back(
    any_algorithm: type[Any], n_envs: int, tmp_path: Path
) -> None:
    """The best model and the statistics are all that is needed, for any number of environments."""
    env = VecNormalize(steps(2))
    played: Any = VecNormalize(steps(1), training=False, norm_reward=False)
    evaluation = EvalCallback(played, best_model_save_path=str(tmp_path), eval_freq=16, warn=False)
    make(any_algorithm, env).learn(64, evaluation)
    played.save(str(tmp_path / "statistics.pkl"))
    again: Any = VecNormalize.load(str(tmp_path / "statistics.pkl"), steps(n_envs))
    again.training = again.norm_reward = False
    best = any_algorithm.load(tmp_path / "best_model", env=again)
    mean, _ = evaluate_policy(best, again, n_eval_episodes=3, warn=False)
    expected, _ = evaluate_policy(best, played, n_eval_episodes=3, warn=False)
    assert mean == pytest.approx(expected, abs=1e-5)
    best.learn(64)
    best.set_env(VecNormalize(steps(n_envs)))
    best.learn(64)


# Old files


def test_custom_objects_of_old_files(any_algorithm: type[Any], tmp_path: Path) -> None:
    """What users give for files of Python and gym versions that are gone."""
    learned(any_algorithm).save(tmp_path / "model")
    given = {
        "learning_rate": 0.0,
        "lr_schedule": lambda _: 0.0,
        "clip_range": lambda _: 0.0,
        "observation_space": OBSERVATIONS,
        "action_space": ACTIONS,
    }
    model = any_algorithm.load(tmp_path / "model", custom_objects=given)
    assert (model.learning_rate, model.clip_range(1.0)) == (0.0, 0.0)
    before = weights(model)
    model.set_env(steps())
    assert th.equal(weights(model.learn(32)), before)


def test_custom_objects_of_another_space(any_algorithm: type[Any], tmp_path: Path) -> None:
    learned(any_algorithm).save(tmp_path / "model")
    wrong = {"action_space": spaces.Box(-1, 1, (5,))}
    with pytest.raises(RuntimeError, match="size mismatch"):
        any_algorithm.load(tmp_path / "model", custom_objects=wrong)


# Where files lie


@pytest.mark.parametrize(
    "name", ["model", "model.zip", "v1.2.3", "my model", "Müßiggang", "new/folder/model", "模型"]
)
@pytest.mark.parametrize("kind", [str, Path])
def test_names_of_files(any_algorithm: type[Any], name: str, kind: Any, tmp_path: Path) -> None:
    model = make(any_algorithm)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SB3 says that it makes the folder
        model.save(kind(tmp_path / name))
    assert th.equal(weights(any_algorithm.load(kind(tmp_path / name))), weights(model))


def test_streams(any_algorithm: type[Any], tmp_path: Path) -> None:
    model = make(any_algorithm)
    memory = io.BytesIO()
    model.save(memory)
    memory.seek(0)
    assert th.equal(weights(any_algorithm.load(memory)), weights(model))
    with open(tmp_path / "open", "wb") as file:
        model.save(file)
    with open(tmp_path / "open", "rb") as file:
        assert th.equal(weights(any_algorithm.load(file)), weights(model))


def test_stream_at_an_offset(any_algorithm: type[Any]) -> None:
    model = make(any_algorithm)
    memory = io.BytesIO(b"header")
    memory.seek(6)
    model.save(memory)
    memory.seek(0)
    assert memory.read(6) == b"header"
    memory.seek(6)
    assert th.equal(weights(any_algorithm.load(memory)), weights(model))


def test_what_is_no_path(any_algorithm: type[Any], tmp_path: Path) -> None:
    """Refused with the same error by all."""

    class OwnPath:
        def __fspath__(self) -> str:
            return str(tmp_path / "model")

    model = make(any_algorithm)
    with tempfile.NamedTemporaryFile() as named:
        for path in (named, OwnPath(), pathlib.PurePath(tmp_path / "model")):
            with pytest.raises(TypeError):
                model.save(path)


def test_trained_on_another_machine(any_algorithm: type[Any], tmp_path: Path) -> None:
    """A file loads without an environment, acts, and says what it needs to learn."""
    env = make_vec_env("Pendulum-v1")
    make(any_algorithm, env, learning_rate=FloatSchedule(1e-3)).learn(32).save(tmp_path / "model")
    model = any_algorithm.load(tmp_path / "model")
    assert model.get_env() is None
    assert model.predict(env.reset())[0].shape == (1, 1)
    with pytest.raises(AssertionError if any_algorithm is PPO else ValueError):
        model.learn(32)
