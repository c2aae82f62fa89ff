"""What a run asks of the processes that train its model: one alone, or several together."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

from stable_baselines3.common.type_aliases import MaybeCallback


class LearnArguments(NamedTuple):
    """The arguments of SB3's ``learn``, in its order."""

    total_timesteps: int
    callback: MaybeCallback
    log_interval: int
    tb_log_name: str
    reset_num_timesteps: bool
    progress_bar: bool


class Training(ABC):
    """One ``learn`` of a model, as this process takes part in it."""

    @abstractmethod
    def run(self, learn: Callable[..., object], arguments: LearnArguments) -> None:
        """Train the model.

        :param learn: SB3's, of this process' model.
        :param arguments: Its arguments.
        """

    @abstractmethod
    def end_rollout(self, complete: bool) -> bool:
        """Whether the training goes on after a rollout.

        :param complete: Whether this process has completed its part; else a callback has stopped
            the training.
        """


class TrainingAlone(Training):
    """That of a model that only this process trains."""

    def run(self, learn: Callable[..., object], arguments: LearnArguments) -> None:
        learn(*arguments)

    def end_rollout(self, complete: bool) -> bool:
        return complete
