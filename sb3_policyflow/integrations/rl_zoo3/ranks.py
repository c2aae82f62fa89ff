"""An experiment of rl_zoo3 that torchrun has started with several ranks."""

import sys
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any

from stable_baselines3.common.utils import get_device

from sb3_policyflow.distributed.ranks import Ranks, current

MARK = ".torchrun"
"""A file in a run's folder, with which a restarted run finds it again."""


def share_experiment(manager: Any) -> None:
    """Share an experiment out among the ranks, if there are several.

    ``n_envs`` counts the environments of all ranks, each of which makes its share. They have the
    seeds and the monitor files that they would have in one process. Rank 0 owns the run's folder.

    :param manager: rl_zoo3's ``ExperimentManager``, for one of this package's algorithms.
    :raises ValueError: If the experiment is a search for hyperparameters.
    """
    ranks = current()
    if ranks.size == 1:
        return
    if manager.optimize_hyperparameters:
        raise ValueError(
            "--optimize runs many trainings, and ranks train one: start the command several times "
            "without torchrun, with one --storage."
        )
    from sb3_policyflow.distributed import restart
    from sb3_policyflow.distributed.group import process_group

    group = process_group()
    group.connect(get_device(manager.device))
    manager.seed, run_id = group.from_first((manager.seed, restart.run_id()))
    own = _marked_folder(manager, run_id) if restart.is_restarted() else None
    manager.save_path = group.from_first(str(own or manager.save_path))
    manager.params_path = f"{manager.save_path}/{manager.env_name}"
    manager.create_envs = _sharing(manager.create_envs, ranks)
    if ranks.rank > 0:
        _leave_the_folder_alone(manager)
    else:
        manager.create_log_folder = _marking(manager, run_id)


def _marked_folder(manager: Any, run_id: str) -> Path | None:
    """The folder of a run that torchrun has restarted."""
    marks = Path(manager.log_path).glob(f"{manager.env_name}_*/{MARK}")
    return next((m.parent for m in marks if m.read_text(encoding="utf-8") == run_id), None)


def _marking(manager: Any, run_id: str) -> Callable[[], None]:
    """``create_log_folder``, which leaves a mark in it."""
    create = manager.create_log_folder

    @wraps(create)
    def create_and_mark() -> None:
        create()
        (Path(manager.save_path) / MARK).write_text(run_id, encoding="utf-8")

    return create_and_mark


def _sharing(create_envs: Callable[..., Any], ranks: Ranks) -> Callable[..., Any]:
    """``create_envs``, which makes this rank's share of the training environments."""

    @wraps(create_envs)
    def create_own_envs(
        n_envs: int, eval_env: bool = False, no_log: bool = False
    ) -> Any:  # a VecEnv
        if eval_env:
            return create_envs(n_envs, eval_env=True, no_log=no_log)
        n_own = ranks.share("n_envs", n_envs)
        # rl_zoo3 numbers monitor files from 0.
        module: Any = sys.modules["rl_zoo3.exp_manager"]
        make_vec_env = module.make_vec_env
        module.make_vec_env = partial(make_vec_env, start_index=ranks.rank * n_own)
        try:
            return create_envs(n_own, no_log=no_log)
        finally:
            module.make_vec_env = make_vec_env

    return create_own_envs


def _leave_the_folder_alone(manager: Any) -> None:
    """Let this rank neither evaluate nor write."""
    manager.eval_freq = manager.save_freq = -1
    manager.show_progress, manager.verbose = False, 0

    def nothing(*_: object) -> None:
        pass

    manager.create_log_folder = manager._save_config = manager.save_trained_model = nothing
