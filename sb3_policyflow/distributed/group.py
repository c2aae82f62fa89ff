"""Ranks that torch.distributed connects: gloo between CPUs, nccl between GPUs."""

import atexit
import functools
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any, TypeVar

import torch as th
from torch import distributed as dist
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from sb3_policyflow.distributed.ranks import RankError, Ranks
from sb3_policyflow.distributed.shared_memory import SharedSum, can_be_shared, share_memory

T = TypeVar("T")
UPDATE_TIMEOUT = timedelta(minutes=10)
"""How long an update waits for a rank that neither answers nor closes its connections."""
ROLLOUT_TIMEOUT = timedelta(days=1)
"""How long ranks wait between updates: while rank 0 evaluates, for instance."""
LEAST_SHARED = 2**18
"""Bytes of memory that ranks of one machine share, at least."""
SENTENCE = "sb3_policyflow/sentence"
"""Where a rank that stops leaves its sentence for the others."""


class ProcessGroup(Ranks):
    """The ranks of a process group of torch.distributed.

    Each collective operation is called by every rank, in the same order. A rank that stops with an
    error leaves its sentence in the group's store and closes its connections. That ends the
    operation in which the others wait, or the next one, with a :class:`RankError`.

    :param rank: This process.
    :param size: How many there are.
    """

    def __init__(self, rank: int, size: int) -> None:
        super().__init__(rank, size)
        self._control: Any = None  # a group of CPUs, for what is not part of an update
        self._store: Any = None
        self._shared_sum: SharedSum | None = None
        self._may_share = True
        self._has_stopped = False

    # The beginning and the end

    def connect(self, device: th.device) -> None:
        """Find the other ranks, unless that has been done; all ranks do so.

        :param device: Where the model is.
        :raises RankError: If this group has stopped with an error.
        :raises ValueError: If there are fewer GPUs than ranks.
        """
        if self._has_stopped:
            raise RankError("These ranks have stopped with an error: start the processes anew.")
        if self._control is not None:
            return
        with self._answered():
            if not dist.is_initialized():
                backend = "nccl" if device.type == "cuda" else "gloo"
                if backend == "nccl":
                    _check_gpus()
                _initialize(backend)
                atexit.register(self._close)  # gloo's threads abort a process that leaves them
            self._store = _of_this_attempt(dist.distributed_c10d._get_default_store())
            self._control = dist.new_group(backend="gloo", timeout=ROLLOUT_TIMEOUT)

    @contextmanager
    def together(self) -> Iterator[None]:
        """A block that all ranks run; where it raises on one, it ends on all."""
        try:
            yield
        except BaseException as error:
            self._stop(error)
            raise

    def _stop(self, error: BaseException) -> None:
        """Say why this rank stops, and close its connections."""
        if self._has_stopped:
            return
        self._has_stopped = True
        with suppress(RuntimeError):
            if self._store is not None and not isinstance(error, RankError):
                sentence = f"Rank {self.rank} has stopped. {type(error).__name__}: {error}"
                self._store.set(SENTENCE, sentence)
        if self._shared_sum is not None:
            self._shared_sum.stop()
        self._close()

    def _close(self) -> None:
        """Close the connections to the other ranks."""
        self._control = self._store = None
        if dist.is_initialized():
            with suppress(RuntimeError):
                dist.destroy_process_group()

    @contextmanager
    def _answered(self) -> Iterator[None]:
        """A collective operation, which fails if another rank has stopped."""
        try:
            yield
        except RuntimeError as error:
            raise RankError(self._reason(error)) from error

    def _reason(self, error: RuntimeError) -> str:
        """The sentence of the rank that has stopped, if it has left one."""
        for _ in range(20):  # it is on another connection than the one that was closed
            with suppress(RuntimeError):
                if self._store is not None and self._store.check([SENTENCE]):
                    return str(self._store.get(SENTENCE).decode())
            time.sleep(0.05)
        return f"Another rank is gone without a word, or could not be reached: {error}"

    # What an update needs

    def mean(self, value: th.Tensor) -> float:
        return self.sum(value.detach()).item() / self.size

    def mean_std(self, values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        # Chan's formula for the moments of a union, from those of its parts
        n_values, mean = values.shape[-1], values.mean(-1, keepdim=True)
        moments = th.stack([mean, (values - mean).square().sum(-1, keepdim=True)])
        parts = self._table(moments.flatten()).view(self.size, *moments.shape)
        means, squares = parts[:, 0], parts[:, 1]
        mean = means.mean(0)
        total = squares.sum(0) + n_values * (means - mean).square().sum(0)
        return mean, (total / (self.size * n_values - 1)).sqrt()

    def average_gradients(self, parameters: Iterable[th.nn.Parameter], loss: float) -> float:
        gradients = [p.grad for p in parameters if p.grad is not None]
        precise = th.promote_types(gradients[0].dtype, th.float32)
        own_loss = gradients[0].new_zeros(self.size, dtype=precise)
        own_loss[self.rank] = loss
        self._sum([*gradients, own_loss], divisor=self.size)
        losses = [self.size * part for part in own_loss.tolist()]
        for rank, one in enumerate(losses):
            if not math.isfinite(one):
                raise FloatingPointError(
                    f"The loss of rank {rank} is not finite (loss {one}). The parameters are "
                    "those of the last good step and can be saved: lower the learning rate."
                )
        return math.fsum(losses) / self.size

    def average_metrics(self, metrics: Mapping[str, float]) -> dict[str, float]:
        rows = self._table(th.tensor(list(metrics.values()), dtype=th.float64, device="cpu"))
        means, maxima = rows.mean(dim=0).tolist(), rows.max(dim=0).values.tolist()
        return {
            name: greatest if name.endswith("_max") else mean
            for name, mean, greatest in zip(metrics, means, maxima, strict=True)
        }

    # What is agreed on between updates

    def gather(self, value: T) -> list[T]:
        """Every rank's value, in their order, on every rank."""
        values: list[Any] = [None] * self.size
        with self._answered():
            dist.all_gather_object(values, value, group=self._control)
        return values

    def gather_on_first(self, value: T) -> list[T]:
        """Every rank's value on rank 0; nothing on the others."""
        values: list[Any] = [None] * self.size if self.rank == 0 else []
        with self._answered():
            dist.gather_object(value, values or None, dst=0, group=self._control)
        return values

    def from_first(self, value: T) -> T:
        """The value of rank 0."""
        values = [value if self.rank == 0 else None]
        with self._answered():
            dist.broadcast_object_list(values, src=0, group=self._control)
        received: Any = values[0]
        return received if self.rank > 0 else value

    def sum(self, values: th.Tensor) -> th.Tensor:
        """The sum of the ranks' tensors."""
        total = values.clone()
        self._sum([total])
        return total

    def _table(self, row: th.Tensor) -> th.Tensor:
        """Every rank's row (n,), as a tensor (size, n)."""
        table = row.new_zeros(self.size, len(row))
        table[self.rank] = row
        self._sum([table])
        return table

    def _sum(self, tensors: list[th.Tensor], divisor: int = 1) -> None:
        """Replace tensors by their sums over the ranks, to the last bit the same on each.

        :param tensors: The tensors, of floating-point numbers unless the divisor is 1.
        :param divisor: What the sums are divided by.
        """
        # Ranks must agree on the way. All have tensors of the same shapes on the same kind of
        # device, but one of them may have them in another layout.
        flat = None if can_be_shared(tensors) else _flattened(tensors)
        parts = tensors if flat is None else [flat]
        with self._answered():
            n_bytes = sum(part.nbytes for part in parts)
            shared = self._shared(n_bytes) if tensors[0].device.type == "cpu" else None
            if shared is not None:
                shared.add(parts, divisor)
        if shared is None:
            flat = _flattened(tensors) if flat is None else flat
            takes_cpu = flat.is_cuda or dist.get_backend() != "nccl"
            with self._answered():
                dist.all_reduce(flat, group=None if takes_cpu else self._control)
            if divisor != 1:
                flat /= divisor
        if flat is not None:
            sizes = [tensor.numel() for tensor in tensors]
            sums = zip(th.split(flat, sizes), tensors, strict=True)
            th._foreach_copy_(tensors, [part.view_as(tensor) for part, tensor in sums])

    def _shared(self, n_bytes: int) -> SharedSum | None:
        """Memory through which so many bytes can be added, if all ranks are on one machine."""
        is_small = self._shared_sum is not None and n_bytes > self._shared_sum.capacity
        if self._may_share and (self._shared_sum is None or is_small):
            n_bytes = max(n_bytes, LEAST_SHARED)
            self._shared_sum = share_memory(self, n_bytes, UPDATE_TIMEOUT.total_seconds())
            self._may_share = self._shared_sum is not None
        return self._shared_sum


def _flattened(tensors: list[th.Tensor]) -> th.Tensor:
    """The numbers of tensors, one behind the other, of a type that ranks can add on the CPU."""
    flat = th.cat([tensor.reshape(-1) for tensor in tensors])
    return flat.float() if flat.is_cpu and flat.dtype is th.bfloat16 else flat


@functools.cache
def process_group() -> ProcessGroup:
    """The one group that this process belongs to."""
    if dist.is_initialized():
        return ProcessGroup(dist.get_rank(), dist.get_world_size())
    return ProcessGroup(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))


def _initialize(backend: str) -> None:
    """What torch does by default, with a store that no earlier attempt has written to."""
    store, rank, size = next(rendezvous("env://", timeout=UPDATE_TIMEOUT))
    dist.init_process_group(
        backend, store=_of_this_attempt(store), rank=rank, world_size=size, timeout=UPDATE_TIMEOUT
    )


def _of_this_attempt(store: Any) -> Any:
    """A part of a store: torchrun keeps it when it restarts its processes."""
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    return PrefixStore(f"sb3_policyflow/{attempt}", store)


def _check_gpus() -> None:
    n_ranks, n_gpus = int(os.environ.get("LOCAL_WORLD_SIZE", "1")), th.cuda.device_count()
    if n_ranks > n_gpus:
        raise ValueError(
            f"{n_ranks} ranks on this machine need as many GPUs, but it has {n_gpus}: start "
            f"{n_gpus} of them (torchrun --nproc-per-node {n_gpus}), or train with device='cpu'."
        )
