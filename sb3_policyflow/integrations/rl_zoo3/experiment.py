"""What an experiment of rl_zoo3 needs for this package's algorithms and environments."""

import atexit
import functools
import inspect
import random
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Container
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import optuna
import yaml
from sqlalchemy.exc import IntegrityError, OperationalError, ProgrammingError
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_policyflow.algorithms import ALGORITHMS
from sb3_policyflow.callbacks import warn_of_deterministic_actions
from sb3_policyflow.envs.native import has_own_vectorization, make_native_vec_env
from sb3_policyflow.hints import did_you_mean
from sb3_policyflow.integrations.rl_zoo3.cloning import CloningBeforeTraining
from sb3_policyflow.integrations.rl_zoo3.ranks import share_experiment
from sb3_policyflow.integrations.rl_zoo3.samplers import TASK, Task

ZOO_KEYS = (
    "callback",
    "demonstrations",
    "deterministic_eval",
    "env_kwargs",
    "env_wrapper",
    "frame_stack",
    "imitation_kwargs",
    "monitor_kwargs",
    "n_envs",
    "n_timesteps",
    "normalize",
    "vec_env_wrapper",
)
"""Keys of a YAML file that are for rl_zoo3, or for this module, and not for the algorithm."""


def extend_experiment(manager: Any, own_algorithms: Container[str], config_given: bool) -> None:
    """Adapt a new ``ExperimentManager`` if its algorithm or environment is this package's.

    :param manager: rl_zoo3's ``ExperimentManager``.
    :param own_algorithms: Names of this package's algorithms.
    :param config_given: Whether the user said where the hyperparameters are.
    """
    env_id = manager.env_name.gym_id
    is_own_algorithm = manager.algo in own_algorithms
    CloningBeforeTraining(manager)
    if not config_given:
        manager.config = choose_config(manager.algo, env_id, manager.config)
    # Any other class than DummyVecEnv has been chosen explicitly.
    if manager.vec_env_class is DummyVecEnv and has_own_vectorization(
        gym.spec(env_id), of_this_package=not is_own_algorithm
    ):
        manager.vec_env_class = make_native_vec_env
    read_own_keys(manager)
    if is_own_algorithm:
        share_experiment(manager)
        manager.objective = prune_if_diverged(with_task(manager))
        manager.learn = warn_of_deterministic_evaluation(manager)
        if manager.optimize_hyperparameters and manager.storage:
            create_tables(manager.storage)


def read_own_keys(manager: Any) -> None:
    """Let an experiment read the keys that this package adds to those of rl_zoo3's YAML files.

    ``deterministic_eval`` is whether evaluations that choose a model, or give a trial its value,
    act deterministically; by default they do, except on Atari.

    :param manager: rl_zoo3's ``ExperimentManager``.
    """
    preprocess = manager._preprocess_hyperparams

    @functools.wraps(preprocess)
    def read(hyperparams: dict[str, Any]) -> Any:
        rest = dict(hyperparams)
        given = rest.pop("deterministic_eval", manager.deterministic_eval)
        if not isinstance(given, bool):
            raise SystemExit(f"deterministic_eval must be True or False, got {given!r}.")
        manager.deterministic_eval = given
        if manager.algo in ALGORITHMS:
            check_hyperparams(ALGORITHMS[manager.algo], rest)
        return preprocess(rest)

    manager._preprocess_hyperparams = read


def check_hyperparams(algorithm: type[Any], hyperparams: Collection[str]) -> None:
    """Refuse hyperparameters that an algorithm does not have.

    :param algorithm: Its class.
    :param hyperparams: Names, as in a YAML file or behind ``-params``.
    :raises SystemExit: With the nearest names: a command ends without a traceback.
    """
    arguments = inspect.signature(algorithm).parameters.keys() - {"env", "_init_setup_model"}
    known = {*arguments, *ZOO_KEYS}
    for name in hyperparams:
        if name not in known and name not in getattr(algorithm, "former_names", {}):
            meant = did_you_mean(name, known)
            raise SystemExit(f"{algorithm.__name__} has no hyperparameter {name!r}: {meant}")


def with_task(manager: Any) -> Callable[..., float]:
    """Let the samplers know the task that a trial is for.

    :param manager: rl_zoo3's ``ExperimentManager``.
    :return: Its ``objective``, to replace it.
    """
    objective, preprocess = manager.objective, manager._preprocess_action_noise
    task = Task()

    @functools.wraps(preprocess)
    def note_task(hyperparams: dict[str, Any], saved: dict[str, Any], env: VecEnv) -> Any:
        nonlocal task
        task = Task.of(manager.n_timesteps, env.action_space)
        return preprocess(hyperparams, saved, env)

    @functools.wraps(objective)
    def run(trial: Any) -> float:
        before = TASK.set(task)
        try:
            return float(objective(trial))
        finally:
            TASK.reset(before)

    manager._preprocess_action_noise = note_task
    return run


def warn_of_deterministic_evaluation(manager: Any) -> Callable[..., None]:
    """Tell the user at the end of a training if its evaluations show what it did not learn.

    :param manager: rl_zoo3's ``ExperimentManager``.
    :return: Its ``learn``, to replace it.
    """
    learn = manager.learn

    @functools.wraps(learn)
    def learn_and_compare(model: Any) -> None:
        learn(model)
        evaluations = [each for each in manager.callbacks if isinstance(each, EvalCallback)]
        drawn = [episode["r"] for episode in model.ep_info_buffer or ()]
        if manager.deterministic_eval and evaluations and evaluations[-1].evaluations_results:
            deterministic = evaluations[-1].evaluations_results[-1]
            warn_of_deterministic_actions(
                drawn,
                deterministic,
                "choose models by drawn ones (-params deterministic_eval:"
                "False) and give rl_zoo3.enjoy --stochastic",
            )

    return learn_and_compare


def create_tables(storage: str, n_tries: int = 20) -> None:
    """Create the tables of a new study's database, also while another worker creates them.

    Optuna looks for each table before it creates it, so that of two workers one may fail.

    :param storage: What rl_zoo3's ``--storage`` takes.
    :param n_tries: How often to try.
    """
    if "://" not in storage:
        return
    try:
        optuna.storages.RDBStorage(storage).engine.dispose()
    except (IntegrityError, OperationalError, ProgrammingError):
        if n_tries == 1:
            raise
        time.sleep(random.random())
        create_tables(storage, n_tries - 1)


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
