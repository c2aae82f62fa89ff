"""What an experiment of rl_zoo3 needs for this package's algorithms and environments."""

import atexit
import functools
import shutil
import tempfile
from collections.abc import Callable, Container
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import optuna
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_policyflow.envs.native import has_own_vectorization, make_native_vec_env
from sb3_policyflow.integrations.rl_zoo3.ranks import share_experiment


def extend_experiment(manager: Any, own_algorithms: Container[str], config_given: bool) -> None:
    """Adapt a new ``ExperimentManager`` if its algorithm or environment is this package's.

    :param manager: rl_zoo3's ``ExperimentManager``.
    :param own_algorithms: Names of this package's algorithms.
    :param config_given: Whether the user said where the hyperparameters are.
    """
    env_id = manager.env_name.gym_id
    is_own_algorithm = manager.algo in own_algorithms
    if not config_given:
        manager.config = choose_config(manager.algo, env_id, manager.config)
    # Any other class than DummyVecEnv has been chosen explicitly.
    if manager.vec_env_class is DummyVecEnv and has_own_vectorization(
        gym.spec(env_id), of_this_package=not is_own_algorithm
    ):
        manager.vec_env_class = make_native_vec_env
    if is_own_algorithm:
        share_experiment(manager)
        manager.objective = prune_if_diverged(manager.objective)


def choose_config(algo: str, env_id: str, theirs: str) -> str:
    """The file with the hyperparameters of an algorithm in an environment.

    rl_zoo3's own if it has an entry for the environment, else this package's if that has one, else
    whichever exists.

    :param algo: Name of the algorithm.
    :param env_id: Id of the environment.
    :param theirs: rl_zoo3's file for the algorithm, which need not exist.
    """
    ours = hyperparams_folder() / f"{algo}.yml"
    if not ours.is_file():
        return theirs
    if not Path(theirs).is_file():
        return str(ours)
    only_ours = env_id in _environments(ours) and env_id not in _environments(Path(theirs))
    return str(ours) if only_ours else theirs


@functools.cache
def hyperparams_folder() -> Path:
    """Where the YAML files are: in the installed package, or beside it in a checkout.

    rl_zoo3 reads files by their names, so those of a package in an archive are copied from there to
    a temporary folder.
    """
    package = resources.files("sb3_policyflow")
    if isinstance(package, Path):
        installed = package / "hyperparams"
        return installed if installed.is_dir() else package.parent / "hyperparams"
    copies = Path(tempfile.mkdtemp(prefix="sb3_policyflow_hyperparams_"))
    atexit.register(shutil.rmtree, copies, ignore_errors=True)
    packed = package / "hyperparams"
    for file in packed.iterdir() if packed.is_dir() else ():
        (copies / file.name).write_bytes(file.read_bytes())
    return copies


def _environments(config: Path) -> set[str]:
    return set(yaml.safe_load(config.read_text(encoding="utf-8")))


def prune_if_diverged(objective: Callable[..., float]) -> Callable[..., float]:
    """Prune a trial whose numbers overflow; rl_zoo3 itself prunes those with a ``ValueError``.

    :param objective: rl_zoo3's, which runs a trial and returns its result.
    """

    @functools.wraps(objective)
    def prune(trial: Any) -> float:
        try:
            return objective(trial)
        except ArithmeticError as error:
            raise optuna.TrialPruned(str(error)) from error

    return prune
