"""rl_zoo3's experiment, so that benchmarks train as ``python -m rl_zoo3.train`` does."""

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm


class Experiment(NamedTuple):
    """What is ready to train: ``hyperparams`` are those that rl_zoo3 has made the model with."""

    manager: ExperimentManager
    model: OnPolicyAlgorithm
    hyperparams: dict[str, Any]


def make_experiment(
    algo: str,
    env: str,
    steps: int | None,
    seed: int,
    logs: str,
    hyperparams: Mapping[str, Any] | None = None,
) -> Experiment:
    """Set up an experiment with the hyperparameters of the YAML files.

    :param algo: rl_zoo3's name of the algorithm.
    :param env: Id of the environment.
    :param steps: Environment steps; those of the YAML file if not given.
    :param seed: Seed of the training.
    :param logs: Folder in which rl_zoo3 keeps its files.
    :param hyperparams: What differs from the YAML file.
    """
    manager = ExperimentManager(
        argparse.Namespace(env_kwargs=None),  # what rl_zoo3's enjoy reads of a command line
        algo,
        env,
        logs,
        n_timesteps=0 if steps is None else steps,
        eval_freq=-1,
        hyperparams=dict(hyperparams or {}),
        seed=seed,
        verbose=0,
        device="cpu",
    )
    setup = manager.setup_experiment()
    assert setup is not None  # it is where it optimizes hyperparameters
    model, chosen = setup
    assert isinstance(model, OnPolicyAlgorithm)
    return Experiment(manager, model, chosen)
