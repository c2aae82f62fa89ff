"""A learning rate of the critic's own, in every algorithm."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import learned

ALGORITHMS = [PolicyFlow, FPO, DPPO]
SIZES: dict[str, Any] = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "seed": 0}


def parts(model: Any) -> tuple[th.Tensor, th.Tensor]:
    """What the actor has learned, and the critic, as vectors."""
    critic = {id(parameter) for parameter in model.policy.critic_parameters()}
    own = [p.detach().flatten() for p in learned(model.policy) if id(p) in critic]
    others = [p.detach().flatten() for p in learned(model.policy) if id(p) not in critic]
    return th.cat(others), th.cat(own)


def trained(algorithm: type[Any], **options: Any) -> Any:
    return algorithm("MlpPolicy", "Pendulum-v1", **{**SIZES, **options}).learn(64)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_same_rate_changes_nothing(algorithm: type[Any]) -> None:
    one, other = (trained(algorithm, critic_learning_rate=rate) for rate in (None, 3e-4))
    for ours, theirs in zip(parts(one), parts(other), strict=True):
        assert th.equal(ours, theirs)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_each_part_has_its_rate(algorithm: type[Any]) -> None:
    actor, critic = parts(algorithm("MlpPolicy", "Pendulum-v1", **SIZES))
    of_critic = parts(trained(algorithm, learning_rate=0.0, critic_learning_rate=1e-3))
    of_actor = parts(trained(algorithm, learning_rate=1e-3, critic_learning_rate=0.0))
    assert th.equal(of_critic[0], actor)
    assert not th.equal(of_critic[1], critic)
    assert th.equal(of_actor[1], critic)
    assert not th.equal(of_actor[0], actor)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_step_of_gradient_descent_is_in_proportion(algorithm: type[Any]) -> None:
    """Without kernels; a single step, whose gradients are those of the same parameters."""
    sgd: dict[str, Any] = {"policy_kwargs": {"optimizer_class": th.optim.SGD}}
    sgd |= {"batch_size": 64, "n_epochs": 1, "max_grad_norm": None, "learning_rate": 1e-4}
    before = parts(algorithm("MlpPolicy", "Pendulum-v1", **{**SIZES, **sgd}))
    plain, faster = (
        parts(trained(algorithm, **sgd, critic_learning_rate=rate)) for rate in (None, 5e-4)
    )
    assert th.equal(faster[0], plain[0])
    th.testing.assert_close(faster[1] - before[1], 5 * (plain[1] - before[1]), rtol=1e-2, atol=1e-6)


def test_schedules_are_followed_and_logged(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", critic_learning_rate="lin_1e-3", **SIZES)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * 64)
    logged = pd.read_csv(tmp_path / "progress.csv")["train/critic_learning_rate"].dropna()
    assert logged.tolist() == pytest.approx([7.5e-4, 5e-4, 2.5e-4])


def test_the_adaptive_rate_is_the_actors_alone() -> None:
    """It falls by 1.5 after each epoch; a critic with a rate of 0 does not notice."""
    options: dict[str, Any] = {"desired_kl": 1e-12, "critic_learning_rate": 0.0}
    _, critic = parts(PolicyFlow("MlpPolicy", "Pendulum-v1", **SIZES))
    model = trained(PolicyFlow, **options)
    assert model.adaptive_learning_rate < 3e-4
    assert th.equal(parts(model)[1], critic)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_files_are_those_of_one_rate(algorithm: type[Any], tmp_path: Path) -> None:
    """So the option may be given, changed and left out when a file is loaded."""
    env = gym.make("Pendulum-v1")
    for given in (None, 1e-3):
        model = trained(algorithm, critic_learning_rate=given)
        assert len(model.policy.optimizer.param_groups) == 1
        model.save(tmp_path / "model")
        for taken in (None, 1e-4):
            loaded = algorithm.load(tmp_path / "model", env=env, critic_learning_rate=taken)
            assert loaded.critic_learning_rate == taken
            loaded.learn(64, reset_num_timesteps=False)
        assert algorithm.load(tmp_path / "model").critic_learning_rate == given


def test_what_cannot_be_a_rate_is_refused() -> None:
    with pytest.raises(ValueError, match="critic_learning_rate must not be negative"):
        PolicyFlow("MlpPolicy", "Pendulum-v1", critic_learning_rate=-1.0)
