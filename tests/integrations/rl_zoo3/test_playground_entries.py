"""What the YAML files say of MuJoCo Playground's tasks, which takes no simulator to see."""

import argparse
from pathlib import Path
from typing import Any

import pytest
import yaml
from torch import nn

pytest.importorskip("rl_zoo3")

from rl_zoo3.exp_manager import ExperimentManager

from sb3_policyflow.envs import PLAYGROUND_TASKS
from sb3_policyflow.integrations.rl_zoo3.experiment import hyperparams_folder

ALGOS = ("policyflow", "fpo", "dppo", "ppo")


def entry(algo: str, task: str) -> dict[str, Any]:
    text = (hyperparams_folder() / f"{algo}.yml").read_text()
    found: dict[str, Any] = yaml.safe_load(text)[f"Playground/{task}-v0"]
    return found


@pytest.mark.parametrize("task", PLAYGROUND_TASKS)
@pytest.mark.parametrize("algo", ALGOS)
def test_all_have_one_protocol_and_one_budget(algo: str, task: str) -> None:
    given = entry(algo, task)
    assert given["normalize"] is True
    assert given["n_timesteps"] == 30e6
    assert given["policy"] == "MlpPolicy"
    assert given["n_epochs"] == 16
    assert (given["n_envs"] * given["n_steps"]) % given["batch_size"] == 0
    kwargs = eval(given["policy_kwargs"], {"nn": nn})
    assert kwargs["net_arch"] == {"pi": [32] * 4, "vf": [256] * 5}
    assert kwargs["activation_fn"] is nn.SiLU


@pytest.mark.parametrize("task", PLAYGROUND_TASKS)
@pytest.mark.parametrize("algo", ALGOS)
def test_algorithms_train_with_their_entries(algo: str, task: str, tmp_path: Path) -> None:
    """On another task, in two environments: arguments and networks are what is tested."""
    config = tmp_path / "config.yml"
    shorter = {"n_envs": 2, "n_steps": 4, "batch_size": 4, "n_epochs": 1, "n_timesteps": 8}
    config.write_text(yaml.safe_dump({"Pendulum-v1": entry(algo, task) | shorter}))
    manager = ExperimentManager(
        argparse.Namespace(),
        algo,
        "Pendulum-v1",
        str(tmp_path),
        eval_freq=-1,
        log_interval=-1,
        seed=1,
        verbose=0,
        device="cpu",
        config=str(config),
    )
    setup = manager.setup_experiment()
    assert setup is not None
    model, saved = setup
    assert saved == entry(algo, task) | shorter
    manager.learn(model)
    assert model.num_timesteps == 8
