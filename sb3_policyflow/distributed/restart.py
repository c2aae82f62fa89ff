"""Going on by itself when torchrun has restarted its processes (``--max-restarts``)."""

import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EventCallback,
)
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_policyflow.distributed.group import ProcessGroup


def is_restarted() -> bool:
    """Whether torchrun has started these processes anew, after one of them had failed."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")) > 0


def run_id() -> str:
    """What tells one call of torchrun from all others, restarts included."""
    parent = os.getppid()
    stat = Path(f"/proc/{parent}/stat")
    # Process ids come again, in containers above all: with the time of its start it is unique.
    started = stat.read_text(encoding="utf-8").rsplit(")")[-1].split()[19] if stat.exists() else ""
    name = os.environ.get("TORCHELASTIC_RUN_ID", "none")
    return f"{name}-{socket.gethostname()}-{parent}-{started}"


def counters(model: Any) -> list[str]:
    """The attributes that say what a run has done, besides parameters and optimizer.

    :param model: The model.
    """
    names = ("num_timesteps", "_n_updates", "_episode_num", "n_rollouts", "adaptive_learning_rate")
    return [
        name for name in (*names, "_adaptive_start", "cloned_parameters") if hasattr(model, name)
    ]


def take_up(model: Any, group: ProcessGroup, callback: BaseCallback) -> bool:
    """Let a model go on from the last checkpoint of a run that torchrun has restarted.

    Rank 0 reads the newest file of this run that a ``CheckpointCallback`` has written, such as
    :class:`~sb3_policyflow.resilience.checkpoints.RolloutCheckpointCallback`. Every rank gets its
    random states. Environments begin new episodes.

    :param model: This rank's, as the script has made it.
    :param group: The ranks, which all call this.
    :param callback: All callbacks of the training.
    :return: Whether there is such a file.
    """
    if not group.from_first(is_restarted()):
        return False
    data, parameters = _newest(model, callback) if group.rank == 0 else ({}, {})
    states = group.from_first(_states(data))
    if not states:
        return False
    if group.rank == 0:
        model.set_parameters(parameters, device=model.device)
        names = (*counters(model), "ep_info_buffer", "ep_success_buffer")
        vars(model).update({name: data[name] for name in names if name in data})
        normalize = model.get_vec_normalize_env()
        if normalize is not None:
            vars(normalize).update(states[0].statistics or {})
    model.num_timesteps = group.from_first(model.num_timesteps)
    model._last_obs = None  # new episodes
    if group.rank < len(states):
        model._saved_random_states = states[group.rank].random_states
    return True


def _states(data: dict[str, Any]) -> list[Any]:
    """What a file has for each rank."""
    first = data.get("resume_state")
    return [] if first is None else [first, *first.others]


def _newest(model: Any, callback: BaseCallback) -> tuple[dict[str, Any], Any]:
    """What is in the newest checkpoint of this run; nothing if there is none."""
    for _, path in sorted(_checkpoints(callback), reverse=True):
        data, parameters, _ = load_from_zip_file(path, device=model.device)
        if data is not None and data.get("run_id") == model.run_id:
            return data, parameters
    return {}, {}


def _checkpoints(callback: BaseCallback) -> Iterator[tuple[int, Path]]:
    """The timestep and the path of each file that the checkpoint callbacks have written."""
    if isinstance(callback, CallbackList):
        for each in callback.callbacks:
            yield from _checkpoints(each)
    elif isinstance(callback, EventCallback) and callback.callback is not None:
        yield from _checkpoints(callback.callback)
    elif isinstance(callback, CheckpointCallback):
        name = re.compile(rf"{re.escape(callback.name_prefix)}_(\d+)_steps\.zip")
        for path in Path(callback.save_path).glob("*.zip"):
            if match := name.fullmatch(path.name):
                yield int(match[1]), path
