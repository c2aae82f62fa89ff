"""Callbacks where several ranks train: counted once, on all of them or on rank 0."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EventCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.type_aliases import MaybeCallback

ON_FIRST_ONLY = (CheckpointCallback, EvalCallback, ProgressBarCallback)
"""Callbacks that write or show something, or evaluate; those derived from them too."""


def as_callback(callback: MaybeCallback, progress_bar: bool) -> BaseCallback:
    """One callback of what ``learn`` takes.

    :param callback: A callback, a list of them, a function, or None.
    :param progress_bar: Whether to add SB3's progress bar.
    """
    if isinstance(callback, list):
        callback = CallbackList(callback)
    elif not isinstance(callback, BaseCallback):
        callback = ConvertCallback(callback)
    return CallbackList([callback, ProgressBarCallback()]) if progress_bar else callback


def without_outputs(callback: BaseCallback) -> BaseCallback | None:
    """What remains of a callback where only rank 0 writes and evaluates.

    :param callback: The callback, whose parts are taken out in place.
    :return: The callback, or None if nothing remains.
    """
    if isinstance(callback, ON_FIRST_ONLY):
        return None
    if isinstance(callback, CallbackList):
        remaining = map(without_outputs, callback.callbacks)
        callback.callbacks = [each for each in remaining if each is not None]
    elif isinstance(callback, EventCallback) and callback.callback is not None:
        callback.callback = without_outputs(callback.callback)
    return callback


class RankCallback(BaseCallback):
    """Stands before the user's callbacks: counts the steps of all ranks, and their episodes.

    SB3's loop counts the steps of its own environments.

    :param callback: The user's.
    :param n_others: How many ranks there are besides this one.
    :param synchronize: Called by every rank where nothing is under way: before a rollout, and at
        the end of the training.
    """

    def __init__(
        self, callback: BaseCallback, n_others: int, synchronize: Callable[[], None]
    ) -> None:
        super().__init__()
        self.callback = callback
        self.n_others = n_others
        self.synchronize = synchronize
        self.episodes: list[Any] = []
        """``Monitor``'s account of the episodes that have ended in this rollout."""
        self.successes: list[Any] = []

    def _init_callback(self) -> None:
        self.callback.init_callback(self.model)

    def _on_training_start(self) -> None:
        self.callback.on_training_start(self.locals, self.globals)

    def _on_rollout_start(self) -> None:
        self.synchronize()
        self.episodes, self.successes = [], []
        self.callback.on_rollout_start()

    def _on_step(self) -> bool:
        self.model.num_timesteps += self.n_others * self.training_env.num_envs
        self.num_timesteps = self.model.num_timesteps
        infos = self.locals["infos"]
        dones = th.as_tensor(self.locals["dones"]).cpu().numpy()
        for index in np.flatnonzero(dones).tolist():
            for name, found in (("episode", self.episodes), ("is_success", self.successes)):
                if infos[index].get(name) is not None:
                    found.append(infos[index][name])
        return self.callback.on_step()

    def _on_rollout_end(self) -> None:
        self.callback.on_rollout_end()

    def _on_training_end(self) -> None:
        self.synchronize()
        self.callback.on_training_end()

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        self.callback.update_locals(locals_)
