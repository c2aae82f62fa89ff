"""What ranks do together before, between and after the updates of a model."""

import inspect
import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger

from sb3_policyflow.distributed import restart
from sb3_policyflow.distributed.callback import RankCallback, as_callback, without_outputs
from sb3_policyflow.distributed.group import ProcessGroup, process_group
from sb3_policyflow.distributed.statistics import MergedStatistics, running_statistics
from sb3_policyflow.resilience.training import LearnArguments, Training, TrainingAlone

OWN = {"env", "policy", "seed", "verbose", "tensorboard_log", "device", "stats_window_size"}
"""Arguments in which the ranks may differ, or that cannot be compared."""


LARGEST_OBSERVATIONS = 2**20
"""Bytes of a rank's last observations up to which they go into a file: all go through rank 0."""


class RolloutReport(NamedTuple):
    """What a rank tells the others at the end of its part of a rollout.

    Whether it is complete, the timestep, ``Monitor``'s accounts of the episodes that have ended and
    whether they were a success, and a number that tells the parameters from others.
    """

    complete: bool
    num_timesteps: int
    episodes: list[Any]
    successes: list[Any]
    checksum: float


class SharedTraining(Training):
    """One ``learn`` of a model that several ranks train, each in environments of its own.

    What is counted or given for all environments counts for those of all ranks: ``batch_size``,
    ``total_timesteps``, ``num_timesteps`` and what follows it. Rank 0 logs, evaluates and saves.

    All ranks start with the parameters, the optimizer, the counters and the statistics of
    ``VecNormalize`` of rank 0. The update itself is the algorithm's, with the help of
    :class:`~sb3_policyflow.distributed.ranks.Ranks`.

    :param model: This rank's.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        self.group: ProcessGroup = process_group()
        self._callback: RankCallback
        self._statistics: MergedStatistics

    def run(self, learn: Callable[..., object], arguments: LearnArguments) -> None:
        """Call SB3's ``learn`` on every rank, and end all if one of them ends with an error.

        :param learn: SB3's, of this rank's model.
        :param arguments: Its arguments.
        :raises RankError: If another rank has stopped with an error.
        :raises ValueError: If the ranks differ, or something cannot be shared out.
        """
        model, group = self.model, self.group
        n_steps, is_new = arguments.total_timesteps, arguments.reset_num_timesteps
        with self._of_model(), group.together():
            group.connect(model.device)
            self._check(n_steps)
            callback = as_callback(arguments.callback, arguments.progress_bar)
            end = n_steps if is_new else n_steps + model.num_timesteps
            model.run_id = group.from_first(restart.run_id())
            if restart.take_up(model, group, callback):
                n_steps, is_new = max(end - model.num_timesteps, 0), False
            self._start_alike()
            rest = arguments.log_interval, arguments.tb_log_name, is_new
            learn(n_steps, self._around(callback), *rest, progress_bar=False)

    @contextmanager
    def _of_model(self) -> Iterator[None]:
        """A block in which this is the model's training."""
        self.model._training = self
        try:
            yield
        finally:
            self.model._training = TrainingAlone()

    def _check(self, total_timesteps: int) -> None:
        """Refuse ranks that would not do the same, and what cannot be shared out."""
        model, group = self.model, self.group
        names = inspect.signature(type(model)).parameters.keys() & vars(model).keys() - OWN
        mine: dict[str, Any] = {
            "algorithm": type(model).__name__,
            "total_timesteps": total_timesteps,
            "n_envs": model.n_envs,
            "number of parameters": sum(p.numel() for p in model.policy.parameters()),
            "VecNormalize": [
                s.mean.shape for s in running_statistics(model.get_vec_normalize_env())
            ],
        }
        given = {name: getattr(model, name) for name in sorted(names)}
        mine |= {
            name: _ends(v) if callable(v) and not isinstance(v, type) else comparable(v)
            for name, v in given.items()
        }
        mine |= {name: comparable(value) for name, value in model.known_policy_options.items()}
        for rank, other in enumerate(group.gather(mine)):
            for name in mine:
                if other.get(name) != mine[name]:
                    raise ValueError(
                        f"All ranks must have the same {name}, but rank {group.rank} has "
                        f"{mine[name]!r} and rank {rank} has {other.get(name)!r}."
                    )
        group.share("batch_size", model.batch_size)

    def _start_alike(self) -> None:
        """Give every rank what rank 0 starts with."""
        model, normalize = self.model, self.model.get_vec_normalize_env()
        statistics = running_statistics(normalize)
        progress = {name: getattr(model, name) for name in restart.counters(model)}
        mine = io.BytesIO()
        if self.group.rank == 0:
            th.save((model.get_parameters(), progress, statistics), mine)
        else:
            model.set_logger(Logger(folder=None, output_formats=[]))
        first = io.BytesIO(self.group.from_first(mine.getvalue()))
        if self.group.rank > 0:
            loaded = th.load(first, map_location=model.device, weights_only=False)
            parameters, progress, theirs = loaded
            model.set_parameters(parameters, device=model.device)
            vars(model).update(progress)
            for own, other in zip(statistics, theirs, strict=True):
                vars(own).update(vars(other))
        self._statistics = MergedStatistics(statistics, self.group.sum)

    def _around(self, callback: BaseCallback) -> BaseCallback:
        """The user's callbacks as this rank calls them.

        :param callback: All of them.
        """
        own = callback if self.group.rank == 0 else without_outputs(callback)
        own = CallbackList([]) if own is None else own
        self._callback = RankCallback(own, self.group.size - 1, self._synchronize)
        return self._callback

    def _synchronize(self) -> None:
        """Where nothing is under way: bring to rank 0 what a file needs, and buffers from it."""
        model, group = self.model, self.group
        state = model.own_resume_state()._replace(statistics=None)
        if _n_bytes(state.last_obs) > LARGEST_OBSERVATIONS:
            state = state._replace(last_obs=None, last_episode_starts=None)
        model.other_resume_states = tuple(group.gather_on_first(state)[1:])
        buffers = list(model.policy.buffers())
        if buffers:
            firsts = group.from_first([buffer.cpu() for buffer in buffers])
            for own, first in zip(buffers, firsts, strict=True):
                if not th.equal(own.cpu(), first):
                    own.copy_(first)

    def end_rollout(self, complete: bool) -> bool:
        """Agree on how a rollout has ended, and merge what was counted in it.

        :param complete: Whether this rank's part is complete; else a callback has stopped it.
        :return: Whether all parts are.
        :raises RuntimeError: If the ranks' parameters are not the same.
        """
        model, mine = self.model, self._callback
        checksum = sum(float(p.detach().double().sum()) for p in model.policy.parameters())
        report = RolloutReport(
            complete, model.num_timesteps, mine.episodes, mine.successes, checksum
        )
        reports = self.group.gather(report)
        if len({each.checksum for each in reports}) > 1:
            raise RuntimeError(
                "The ranks' parameters are no longer the same: a callback may change them, or the "
                "machines may not compute alike. Do so on every rank, or on machines of one kind."
            )
        self._statistics.merge()
        for rank, other in enumerate(reports):
            if rank != self.group.rank:
                model.ep_info_buffer.extend(other.episodes)
                model.ep_success_buffer.extend(other.successes)
        stopped = [each.num_timesteps for each in reports if not each.complete]
        if stopped:
            model.num_timesteps = min(stopped)
        return not stopped


def comparable(value: Any) -> Any:
    """The value of an option as ranks can compare it, which are processes of their own.

    >>> comparable({"net_arch": (8, 8), "activation_fn": lambda inputs: inputs})
    {'net_arch': [8, 8], 'activation_fn': '<function <lambda>>'}

    :param value: The value; of what is neither a number nor a collection, the ``repr`` without
        addresses in memory counts.
    """
    if isinstance(value, (int, float, str, type(None))):
        return value
    if isinstance(value, Mapping):
        return {name: comparable(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [comparable(each) for each in value]
    if isinstance(value, (set, frozenset)):  # whose order is a process's own
        return sorted(map(str, map(comparable, value)))
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def _ends(function: Callable[..., Any]) -> Any:
    """A schedule by its values at the start and at the end, another function by its name."""
    try:
        start, end = float(function(1.0)), float(function(0.0))
    except Exception:  # it belongs to an algorithm of the user's own, and may do anything
        return comparable(function)
    return start if start == end else f"{start} at first and {end} at the end"


def _n_bytes(observations: Any) -> int:
    """The size of observations, an array or a dictionary of them."""
    arrays = observations.values() if isinstance(observations, dict) else [observations]
    return sum(np.asarray(array).nbytes for array in arrays)
