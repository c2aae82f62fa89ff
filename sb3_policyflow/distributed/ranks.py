"""The processes that train one model together, and what an update asks of them."""

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import torch as th

from sb3_policyflow.resilience.training import Training, TrainingAlone


class RankError(RuntimeError):
    """Another rank has stopped: its sentence, or that it is gone."""


class Ranks(ABC):
    """The processes that train one model, each with environments of its own.

    All have the same number of environments, so that a minibatch is made of equal shares and the
    mean over all its samples is the mean of the ranks' means.

    :param rank: Which one this process is, from 0. Rank 0 logs, evaluates and saves.
    :param size: How many there are.
    """

    def __init__(self, rank: int, size: int) -> None:
        self.rank = rank
        self.size = size

    def share(self, name: str, total: int) -> int:
        """A rank's share of a number that counts for all ranks together.

        >>> Alone().share("batch_size", 64)
        64

        :param name: What is shared out, for the message.
        :param total: The number for all ranks.
        :raises ValueError: If it cannot be shared out equally.
        """
        if total % self.size:
            raise ValueError(
                f"{name}={total} counts for all {self.size} ranks together and cannot be shared "
                f"out equally: make it a multiple of {self.size}."
            )
        return total // self.size

    def normalized(self, values: th.Tensor) -> th.Tensor:
        """Values with mean 0 and standard deviation 1 over all ranks; a single one as it is.

        :param values: This rank's, shape (..., n), normalized along the last dimension.
        """
        if self.size * values.shape[-1] < 2:
            return values
        mean, std = self.mean_std(values)
        return (values - mean) / (std + 1e-8)

    @abstractmethod
    def mean(self, value: th.Tensor) -> float:
        """The mean over the ranks of a tensor without dimensions."""

    @abstractmethod
    def mean_std(self, values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and standard deviation, as ``Tensor.std`` has it, of all ranks' values together.

        :param values: This rank's, shape (..., n), the same on each.
        :return: Two tensors of shape (..., 1).
        """

    @abstractmethod
    def average_gradients(self, parameters: Iterable[th.nn.Parameter], loss: float) -> float:
        """Replace gradients by their means over the ranks.

        :param parameters: Those whose gradients are averaged, where they have one.
        :param loss: This rank's loss.
        :return: The mean loss.
        :raises FloatingPointError: On every rank, if the loss of one is not finite.
        """

    @abstractmethod
    def average_metrics(self, metrics: Mapping[str, float]) -> dict[str, float]:
        """The means over the ranks; of names that end in "_max", the greatest."""


class Alone(Ranks):
    """One process, which agrees with itself."""

    def __init__(self) -> None:
        super().__init__(rank=0, size=1)

    def mean(self, value: th.Tensor) -> float:
        return value.item()

    def mean_std(self, values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return values.mean(-1, keepdim=True), values.std(-1, keepdim=True)

    def average_gradients(
        self,
        parameters: Iterable[th.nn.Parameter],  # noqa: ARG002
        loss: float,
    ) -> float:
        return loss

    def average_metrics(self, metrics: Mapping[str, float]) -> dict[str, float]:
        return dict(metrics)


ENVIRONMENT = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
"""What torchrun tells each process, by environment variables."""


def current() -> Ranks:
    """The ranks that this process belongs to.

    It belongs to several if torchrun has started it, or if ``torch.distributed`` has been
    initialized by the user. They have not been connected yet.
    """
    is_started = all(name in os.environ for name in ENVIRONMENT)
    if (is_started and int(os.environ["WORLD_SIZE"]) > 1) or _is_initialized():
        from sb3_policyflow.distributed.group import process_group

        return process_group()
    return Alone()


def _is_initialized() -> bool:
    distributed = th.distributed
    return (
        distributed.is_available()
        and distributed.is_initialized()
        and distributed.get_world_size() > 1
    )


def join(device: th.device | str) -> Ranks:
    """The ranks that this process belongs to; of several, each has a GPU of its own.

    :param device: Where the user wants the model.
    """
    ranks = current()
    if ranks.size > 1:
        use_own_gpu(device)
    return ranks


def training_of(model: Any) -> Training:
    """A ``learn`` of a model, which its ranks call together if there are several.

    :param model: This rank's.
    """
    if model.ranks.size == 1:
        return TrainingAlone()
    from sb3_policyflow.distributed.training import SharedTraining

    return SharedTraining(model)


def use_own_gpu(device: th.device | str) -> None:
    """Let "cuda" mean the GPU that torchrun has for this process.

    :param device: What the user wants; a GPU of a number of its own stays that one.
    """
    wanted = th.device("cuda" if device == "auto" else device)
    if wanted.type == "cuda" and th.cuda.is_available():
        own = int(os.environ.get("LOCAL_RANK", "0")) % th.cuda.device_count()
        th.cuda.set_device(own if wanted.index is None else wanted.index)
