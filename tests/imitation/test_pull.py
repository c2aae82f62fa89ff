"""The pull towards a policy that was cloned."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from sb3_policyflow import PolicyFlow
from sb3_policyflow.imitation import clone
from tests.imitation.short import ALGORITHMS, SHORT, pendulum, shown


def test_a_pull_needs_a_cloned_policy() -> None:
    with pytest.raises(ValueError, match="this model was not: call"):
        pendulum(PolicyFlow, imitation_coef=0.1).learn(16)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_pull_is_zero_where_it_begins(algorithm: type[Any]) -> None:
    model = clone(pendulum(algorithm, imitation_coef=1.0, n_critic_warmup=1), shown(), **SHORT)
    model.set_logger(configure(None, []))
    model.learn(16)
    assert model.logger.name_to_value["train/imitation_loss"] == 0.0
    model.learn(16, reset_num_timesteps=False)
    assert model.logger.name_to_value["train/imitation_loss"] > 0.0


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_pull_holds_the_policy_back(algorithm: type[Any], tmp_path: Path) -> None:
    moved = {}
    for coef in (0.0, "lin_1000_1000"):
        options: dict[str, Any] = {"n_epochs": 8, "learning_rate": 3e-3, "imitation_coef": coef}
        model = clone(pendulum(algorithm, **options), shown(), **SHORT)
        # The policy to which it is pulled is in the file.
        model.save(tmp_path / "model")
        model = algorithm.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
        latents, features = th.randn(64, 1), th.randn(64, 3)
        before = model.policy.transport(latents, features).detach()
        model.learn(64)
        change = model.policy.transport(latents, features).detach() - before
        moved[coef] = change.square().mean().item()
    assert moved["lin_1000_1000"] < 0.2 * moved[0.0]
