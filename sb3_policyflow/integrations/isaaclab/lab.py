"""What differs between versions of IsaacLab: how it starts, and how a task is configured."""

import argparse
import difflib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_policyflow.integrations.isaaclab.presets import AGENT_KEY, TASKS, register_presets

Launched = AbstractContextManager["Configured"]


class LabError(ValueError):
    """Something about IsaacLab that its user must change."""


class Configured(NamedTuple):
    """A task as it is to be run, once the simulator is up."""

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
    """The installed IsaacLab, which is told by what it can do: versions of checkouts say little.

    :raises LabError: If there is none, or one that is too old.
    """
    try:
        app = importlib.import_module("isaaclab.app")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "isaaclab":
            raise  # IsaacLab is there, and lacks something of its own
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
    """The simulator comes first: tasks cannot be imported without it."""
    simulation = importlib.import_module("isaaclab.app").AppLauncher(options).app
    check_task(options.task, options.agent)
    hydra = importlib.import_module("isaaclab_tasks.utils.hydra")
    found: list[Configured] = []
    with _arguments(overrides):
        hydra.hydra_task_config(options.task, options.agent)(
            lambda env, agent: found.append(Configured(env, agent))
        )()
    yield found[0]
    # Closing ends the process, so an error must pass first.
    simulation.close()


@contextmanager
def _launched_three(options: argparse.Namespace, overrides: list[str]) -> Iterator[Configured]:
    """The configuration comes first: it decides which simulator to start."""
    check_task(options.task, options.agent)
    utils = importlib.import_module("isaaclab_tasks.utils")
    configured = Configured(
        *utils.resolve_task_config(options.task, options.agent, overrides=overrides)
    )
    with importlib.import_module("isaaclab.app").launch_simulation(configured.env, options):
        yield configured


@contextmanager
def _arguments(overrides: list[str]) -> Iterator[None]:
    """Hydra reads its overrides from the command line."""
    original, sys.argv = sys.argv, [sys.argv[0], *overrides]
    try:
        yield
    finally:
        sys.argv = original


def check_task(task: str, agent: str) -> None:
    """Register IsaacLab's tasks and the presets, and see whether a task can be trained.

    :param task: Its id.
    :param agent: The registry's key of its hyperparameters.
    :raises LabError: If there is no such task, with the nearest ones, or none of its
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
    """What a task may have been called instead: first what another version calls the same."""
    renamed = [name for names in TASKS.values() if task in names for name in names if name]
    tasks = [name for name, spec in gym.registry.items() if "env_cfg_entry_point" in spec.kwargs]
    near = [name for name in renamed if name in tasks]
    near += [name for name in difflib.get_close_matches(task, tasks, 3) if name not in near]
    return f": did you mean {' or '.join(near)}?" if near else ""


def wrap(env: Any, bounds: tuple[float, float]) -> Any:
    """IsaacLab's environment as an SB3 ``VecEnv``.

    :param env: What ``gymnasium.make`` returned.
    :param bounds: Bounds for actions that have none. Version 2 knows no other than +-100.
    :raises LabError: If version 2 is asked for others.
    """
    wrapper = importlib.import_module("isaaclab_rl.sb3").Sb3VecEnvWrapper
    if "action_bounds" in inspect.signature(wrapper).parameters:
        return wrapper(env, action_bounds=bounds)
    if bounds != (-100.0, 100.0):
        raise LabError(
            f"This version of IsaacLab bounds actions by -100 and 100, not by {bounds[0]:g} and "
            f"{bounds[1]:g}: leave out --action_bounds."
        )
    return wrapper(env)


def prepare_timeouts(env_config: Any, timeout_bootstrap: str) -> None:
    """See to it that time limits can be bootstrapped as they are asked to be.

    What IsaacLab gives as the last observation of an episode is the first of the next, unless
    version 3 is told to compute the last one.

    :param env_config: The environment's configuration, changed in place.
    :param timeout_bootstrap: Argument of the algorithm.
    :raises LabError: If the last observations cannot be had.
    """
    if timeout_bootstrap != "terminal":
        return
    if not hasattr(env_config, "compute_final_obs"):
        raise LabError(
            "This version of IsaacLab does not tell the last observation of an episode, which "
            "timeout_bootstrap='terminal' needs: train with agent.timeout_bootstrap=current, as "
            "the presets do, or use IsaacLab 3."
        )
    env_config.compute_final_obs = True
