"""Registration with rl_zoo3: one function for each of its modules to which this package adds.

They run after the module has been executed (see ``sb3_policyflow_startup``), and may run again.
"""

import argparse
import functools
import inspect
import sys
import warnings
from types import ModuleType
from typing import Any

import gymnasium as gym

from sb3_policyflow.algorithms import ALGORITHMS
from sb3_policyflow.envs import ensure_registered
from sb3_policyflow.integrations.rl_zoo3.experiment import extend_experiment
from sb3_policyflow.integrations.rl_zoo3.samplers import SAMPLERS, convert_flow_params


def register(module: ModuleType) -> None:
    """Add to a module of rl_zoo3 what this package has for it.

    :param module: One of ``rl_zoo3.utils``, ``rl_zoo3.hyperparams_opt``, ``rl_zoo3.exp_manager``.
    """
    add = {
        "rl_zoo3.utils": _add_algorithms,
        "rl_zoo3.hyperparams_opt": _add_search_spaces,
        "rl_zoo3.exp_manager": _extend_experiments,
    }
    add[module.__name__](module)


def _add_algorithms(utils: ModuleType) -> None:
    """Let ``--algo`` and ``--env`` know the algorithms and environments."""
    for name, algorithm in ALGORITHMS.items():
        utils.ALGOS.setdefault(name, algorithm)
    _register_environment_of(sys.argv[1:])


def _register_environment_of(arguments: list[str]) -> None:
    """Register the environment that a command's ``--env`` names.

    The commands look it up right after parsing. To register every environment that this package
    knows of would import every simulator.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--env", nargs="?")
    env_id = parser.parse_known_args(arguments)[0].env
    try:
        ensure_registered(env_id or "")
    except gym.error.Error as error:
        warnings.warn(str(error), stacklevel=2)


def _add_search_spaces(hyperparams_opt: ModuleType) -> None:
    """Let ``--optimize`` and ``--trial-id`` know the search spaces."""
    for name, sample in SAMPLERS.items():
        hyperparams_opt.HYPERPARAMS_SAMPLER.setdefault(name, sample)
        hyperparams_opt.HYPERPARAMS_CONVERTER.setdefault(name, convert_flow_params)


def _extend_experiments(exp_manager: ModuleType) -> None:
    """Have :func:`extend_experiment` adapt each new ``ExperimentManager``.

    Its environment is registered first, for scripts that do not name it on the command line.
    """
    manager_class = exp_manager.ExperimentManager
    construct = manager_class.__init__
    if hasattr(construct, "extended_by_sb3_policyflow"):
        return
    signature = inspect.signature(construct)

    @functools.wraps(construct)
    def construct_and_extend(self: Any, *args: Any, **kwargs: Any) -> None:
        given = signature.bind_partial(self, *args, **kwargs).arguments
        ensure_registered(given.get("env_id", ""))
        construct(self, *args, **kwargs)
        extend_experiment(self, own_algorithms=ALGORITHMS, config_given=bool(given.get("config")))

    extended: Any = construct_and_extend
    extended.extended_by_sb3_policyflow = True
    manager_class.__init__ = extended
