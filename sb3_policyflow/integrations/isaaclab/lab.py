"""What differs between IsaacLab 2 and 3: how the simulator starts and how tasks are configured."""

import argparse
import difflib
import importlib
import importlib.util
import inspect
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv

from sb3_policyflow.envs.tensor import TensorEnvAdapter
from sb3_policyflow.integrations.isaaclab.presets import AGENT_KEY, TASKS, register_presets
from sb3_policyflow.integrations.isaaclab.tensors import GROUP, IsaacLabTensorEnv, are_vectors

Launched = AbstractContextManager["Configured"]


class LabError(ValueError):
    """An error that the user must mend, in one sentence that says how."""


class Configured(NamedTuple):
    """Configurations of the environment and of the agent, once the simulator has started."""

    env: Any
    agent: dict[str, Any]


class Lab(NamedTuple):
    """One generation of IsaacLab.

    ``add_arguments`` adds the launcher's arguments to a parser. ``launched(options, overrides)``
    starts the simulator and configures the task ``options.task``.
    """

    add_arguments: Callable[[argparse.ArgumentParser], None]
    launched: Callable[[argparse.Namespace, list[str]], Launched]


def find_lab() -> Lab:
    """The installed IsaacLab, recognized by its functions: checkouts may have any version number.

    :raises LabError: If there is none, or one that is too old.
    """
    try:
        app = importlib.import_module("isaaclab.app")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "isaaclab":
            raise  # IsaacLab is installed, but one of its dependencies is missing.
        raise LabError(_how_to_install()) from error
    if hasattr(app, "launch_simulation"):
        return Lab(app.add_launcher_args, _launched_three)
    if hasattr(app, "AppLauncher"):
        return Lab(app.AppLauncher.add_app_launcher_args, _launched_two)
    raise LabError(
        f"The isaaclab in {app.__file__} is neither version 2 nor 3, which is what this script "
        "works with: install one of them."
    )


def _how_to_install() -> str:
    if importlib.util.find_spec("omni") and _has_module("omni.isaac.lab"):
        return (
            "This is IsaacLab 1, whose package is called omni.isaac.lab, but the script works with "
            "versions 2 and 3: upgrade IsaacLab."
        )
    return (
        "IsaacLab is not installed in this Python: follow "
        "https://isaac-sim.github.io/IsaacLab and start the script with IsaacLab's interpreter, "
        "for instance ./isaaclab.sh -p -m sb3_policyflow.integrations.isaaclab."
    )


def _has_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


@contextmanager
def _launched_two(options: argparse.Namespace, overrides: list[str]) -> Iterator[Configured]:
    """Start the simulator first, because tasks cannot be imported without it."""
    simulation = importlib.import_module("isaaclab.app").AppLauncher(options).app
    check_task(options.task, options.agent)
    hydra = importlib.import_module("isaaclab_tasks.utils.hydra")
    found: list[Configured] = []
    with _arguments(overrides):
        hydra.hydra_task_config(options.task, options.agent)(
            lambda env, agent: found.append(Configured(env, agent))
        )()
    yield found[0]
    # Not in a finally block: closing ends the process, and would hide an error.
    simulation.close()


@contextmanager
def _launched_three(options: argparse.Namespace, overrides: list[str]) -> Iterator[Configured]:
    """Configure first, because the configuration decides which simulator to start."""
    check_task(options.task, options.agent)
    utils = importlib.import_module("isaaclab_tasks.utils")
    configured = Configured(
        *utils.resolve_task_config(options.task, options.agent, overrides=overrides)
    )
    with importlib.import_module("isaaclab.app").launch_simulation(configured.env, options):
        yield configured


@contextmanager
def _arguments(overrides: list[str]) -> Iterator[None]:
    """Put the overrides on the command line, where Hydra reads them."""
    original, sys.argv = sys.argv, [sys.argv[0], *overrides]
    try:
        yield
    finally:
        sys.argv = original


def check_task(task: str, agent: str) -> None:
    """Register IsaacLab's tasks and the presets, and check that a task can be trained.

    :param task: Its id.
    :param agent: The registry's key of its hyperparameters.
    :raises LabError: If there is no such task, with similar names; or if it has no such
        hyperparameters.
    """
    importlib.import_module("isaaclab_tasks")
    with_preset = register_presets()
    if task not in gym.registry:
        raise LabError(f"There is no task {task!r} in this IsaacLab{_nearest(task)}.")
    kwargs = gym.registry[task].kwargs
    if agent in kwargs:
        return
    if agent == AGENT_KEY:
        raise LabError(
            f"There are no hyperparameters for {task}: register yours as its {AGENT_KEY!r}, or "
            f"train one of the paper's tasks: {', '.join(with_preset)}."
        )
    known = ", ".join(sorted(key for key in kwargs if key != "env_cfg_entry_point"))
    raise LabError(f"{task} has no hyperparameters {agent!r}, but {known}: choose with --agent.")


def _nearest(task: str) -> str:
    """Names that may have been meant: first that of the same task in the other version."""
    renamed = [name for names in TASKS.values() if task in names for name in names if name]
    tasks = [name for name, spec in gym.registry.items() if "env_cfg_entry_point" in spec.kwargs]
    near = [name for name in renamed if name in tasks]
    near += [name for name in difflib.get_close_matches(task, tasks, 3) if name not in near]
    return f": did you mean {' or '.join(near)}?" if near else ""


def wrap(env: Any, bounds: tuple[float, float]) -> VecEnv:
    """IsaacLab's environment as an SB3 ``VecEnv``, whose steps remain tensors.

    :param env: What ``gymnasium.make`` returned.
    :param bounds: Bounds for actions that have none.
    :raises LabError: If the bounds cannot be used, or there are several agents.
    """
    low, high = bounds
    if not -math.inf < low < high < math.inf:
        raise LabError(
            f"--action_bounds must be two finite numbers, the lower one first, not {low:g} and "
            f"{high:g}."
        )
    if not hasattr(env.unwrapped, "single_observation_space"):
        raise LabError(
            f"{type(env.unwrapped).__name__} has several agents, and PolicyFlow trains one: choose "
            "another task, or wrap it with isaaclab.envs.multi_agent_to_single_agent in a script "
            "of your own."
        )
    if are_vectors(env.unwrapped.single_observation_space[GROUP]):
        return TensorEnvAdapter(IsaacLabTensorEnv(env, bounds))
    return wrap_for_arrays(env, bounds)


def wrap_for_arrays(env: Any, bounds: tuple[float, float]) -> VecEnv:
    """IsaacLab's environment in its own wrapper for SB3, which returns arrays.

    :param env: What ``gymnasium.make`` returned.
    :param bounds: Bounds for actions that have none. Version 2 has -100 and 100 only.
    :raises LabError: If these are other bounds, and it is version 2.
    """
    make: Callable[..., VecEnv] = importlib.import_module("isaaclab_rl.sb3").Sb3VecEnvWrapper
    if "action_bounds" in inspect.signature(make).parameters:
        return make(env, action_bounds=bounds)
    if bounds != (-100.0, 100.0):
        raise LabError(
            f"This version of IsaacLab bounds actions by -100 and 100, not by {bounds[0]:g} and "
            f"{bounds[1]:g}: leave out --action_bounds."
        )
    return make(env)


def prepare_timeouts(env_config: Any, timeout_bootstrap: str) -> None:
    """Configure the environment for the way in which time limits are bootstrapped.

    As an episode's last observation IsaacLab returns the next episode's first one, unless version 3
    is told to compute the last one.

    :param env_config: The environment's configuration, changed in place.
    :param timeout_bootstrap: The algorithm's argument of this name.
    :raises LabError: If it needs last observations, which version 2 does not return.
    """
    if timeout_bootstrap != "terminal":
        return
    if not hasattr(env_config, "compute_final_obs"):
        raise LabError(
            "This version of IsaacLab does not return the last observation of an episode, which "
            "timeout_bootstrap='terminal' needs: train with agent.timeout_bootstrap=current, as "
            "the presets do, or use IsaacLab 3."
        )
    env_config.compute_final_obs = True
