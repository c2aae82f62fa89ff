"""An argument that does not exist is refused with where it belongs, or which one may be meant."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import SMALL, TINY


def make(algorithm: type[Any], policy: Any = "MlpPolicy", **options: Any) -> Any:
    return algorithm(policy, "Pendulum-v1", **{**SMALL, "policy_kwargs": TINY, **options})


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


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        ("MlpFlowPolic", {}, r"has no policy 'MlpFlowPolic': did you mean MlpFlowPolicy"),
        ("MultiInputPolicy", {}, r"is for observations that are a Dict.*\('MlpPolicy', \.\.\.\)"),
        ("MlpPolicy", {"policy_kwargs": "dict()"}, r"policy_kwargs must be a dictionary"),
        ("MlpPolicy", {"policy_kwargs": {"net_arch": "small"}}, r"such as \[64, 64\].*'small'"),
        ("MlpPolicy", {"policy_kwargs": {"net_arch": [0]}}, r"a list of layer sizes"),
        ("MlpPolicy", {"policy_kwargs": {"net_arch": {"actor": [8]}}}, r"dict\(pi=\[64, 64\], vf"),
        ("MlpPolicy", {"policy_kwargs": {"activation_fn": "relu"}}, r"such as torch\.nn\.ReLU"),
        ("MlpPolicy", {"policy_kwargs": {"activation_fn": nn.ReLU()}}, r"without quotes or brac"),
        (
            "MlpPolicy",
            {"policy_kwargs": {"optimizer_class": "Adam"}},
            r"such as torch\.optim\.A",
        ),
        (
            "MlpPolicy",
            {"policy_kwargs": {"features_extractor_class": "NatureCNN"}},
            r"features_extractor_class must be a class",
        ),
        ("MlpPolicy", {"clip_range": 0.0}, r"clip_range must be positive"),
    ],
    ids=str,
)
def test_values_that_no_policy_can_be_made_of(
    algorithm: type[Any], policy: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        algorithm(policy, "Pendulum-v1", **{**SMALL, **options})


def test_gsde_among_the_options_of_the_policy(algorithm: type[Any]) -> None:
    with pytest.raises(TypeError, match=r"has no use_sde: it belongs to gSDE.*Leave it out"):
        algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs={"use_sde": True}, **SMALL)


def test_load_refuses_attributes_that_no_model_has(algorithm: type[Any], tmp_path: Path) -> None:
    make(algorithm).save(tmp_path / "model")
    with pytest.raises(TypeError, match="no 'gama' to change: did you mean gamma"):
        algorithm.load(tmp_path / "model", gama=0.5)
    changed = algorithm.load(tmp_path / "model", gamma=0.5, num_timesteps=3, tensorboard_log="tb")
    assert (changed.gamma, changed.num_timesteps) == (0.5, 3)


@pytest.mark.parametrize("other", [PPO, A2C, SAC], ids=lambda cls: str(cls.__name__))
def test_a_file_of_another_algorithm_of_sb3(
    algorithm: type[Any], other: type[Any], tmp_path: Path
) -> None:
    other("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}).save(tmp_path / "model")
    with pytest.raises(
        ValueError, match=rf"saved by {other.__name__}, not by {algorithm.__name__}"
    ):
        algorithm.load(tmp_path / "model")


@pytest.mark.parametrize("other", [PolicyFlow, FPO, DPPO], ids=lambda cls: str(cls.__name__))
def test_a_file_of_a_sibling(other: type[Any], tmp_path: Path) -> None:
    make(other).save(tmp_path / "model")
    for algorithm in {PolicyFlow, FPO, DPPO} - {other}:
        with pytest.raises(
            ValueError, match=rf"saved by {other.__name__}.*use {other.__name__}\.l"
        ):
            algorithm.load(tmp_path / "model")
    with pytest.raises(TypeError, match="which PPO needs: make, load and train it with the"):
        PPO.load(tmp_path / "model", env=gym.make("Pendulum-v1")).learn(16)


def test_a_loaded_model_is_not_warned_of_minibatches(algorithm: type[Any], tmp_path: Path) -> None:
    env = make_vec_env("Pendulum-v1", 4)
    algorithm("MlpPolicy", env, n_steps=2, batch_size=8, policy_kwargs=TINY).save(tmp_path / "m")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        algorithm.load(tmp_path / "m", env=gym.make("Pendulum-v1"))


@pytest.mark.parametrize("name", ["learning_rate", "clip_range", "clip_range_vf", "ent_coef"])
def test_one_notation_for_all_schedules(algorithm: type[Any], name: str, tmp_path: Path) -> None:
    model = make(algorithm, **{name: "lin_0.2_0.1"})
    model.learn(64)
    model.save(tmp_path / "model")
    for each in (model, algorithm.load(tmp_path / "model")):
        each._current_progress_remaining = 0.5
        assert each.value_of(name) == pytest.approx(0.15)
    logged = model.logger.name_to_value.get(f"train/{name}")
    assert logged in (None, pytest.approx(0.1))
    with pytest.raises(ValueError, match=rf"{name} must be a number, a string such as 'lin_0\.25'"):
        make(algorithm, **{name: "linear_0.2"})
