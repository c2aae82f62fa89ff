"""Sums over ranks of one machine, through memory that they share.

Between processes of one machine gloo sends through sockets, and each process sleeps until its
answer is there. That takes half a millisecond, as long as the gradients of a small minibatch.
"""

import mmap
import os
import platform
import tempfile
import time
import uuid
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

FOLDER = Path("/dev/shm")
LINE = 64
"""Bytes of the part of memory that one processor changes without disturbing the others."""
SPINS = 2000
"""How often a rank looks for the others before it lets other processes run."""
IS_ORDERED = platform.machine() in ("x86_64", "AMD64")
"""Whether processors see each other's writes in the order in which they were made."""


class SharedSum:
    """Adds arrays of all ranks of one machine, in the same order on each.

    Every rank writes a row and then its turn's number, waits until all have, and adds the rows.
    Rows are written by turns to two places: whoever has begun turn k has read those of turn k - 2.

    :param memory: Shared by all ranks; zeros behind the first line.
    :param rank: This rank.
    :param size: How many there are.
    :param timeout: Seconds to wait for a rank that lives.
    """

    def __init__(self, memory: mmap.mmap, rank: int, size: int, timeout: float) -> None:
        # The first line has the token, then each rank has a line, and two rows.
        head = np.frombuffer(memory, np.int64, size * LINE // 8, offset=LINE).reshape(size, -1)
        self._turns, self._processes, self._stopped = head[:, 0], head[:, 1], head[:, 2]
        self._rows = np.frombuffer(memory, np.uint8, offset=(size + 1) * LINE).reshape(2, size, -1)
        self._rank = rank
        self._timeout = timeout
        self._turn = 0
        self._processes[rank] = os.getpid()

    @property
    def capacity(self) -> int:
        """Bytes of an array, at most."""
        return self._rows.shape[2]

    def add(self, tensors: Sequence[th.Tensor], divisor: int = 1) -> None:
        """Replace tensors by their sums over the ranks.

        :param tensors: Those of which :func:`can_be_shared` is true.
        :param divisor: What the sums are divided by, if it is not 1.
        :raises RuntimeError: If a rank has stopped, or is gone.
        """
        arrays = [tensor.view(-1).numpy() for tensor in tensors]
        ends = list(accumulate(array.size for array in arrays))
        self._turn += 1
        n_bytes, dtype = ends[-1] * arrays[0].itemsize, arrays[0].dtype
        rows = self._rows[self._turn % 2, :, :n_bytes].view(dtype)
        np.concatenate(arrays, out=rows[self._rank])
        self._turns[self._rank] = self._turn
        self._wait()
        with np.errstate(all="ignore"):
            sums = np.add.reduce(rows, axis=0)
            if divisor != 1:
                sums /= divisor
        for array, end in zip(arrays, ends, strict=True):
            array[:] = sums[end - array.size : end]

    def stop(self) -> None:
        """Tell the others that this rank has stopped."""
        self._stopped[self._rank] = 1

    def _wait(self) -> None:
        """Wait until every rank has begun this turn."""
        for _ in range(SPINS):
            if self._turns.min() >= self._turn:
                return
        began = time.monotonic()
        while self._turns.min() < self._turn:
            waited = time.monotonic() - began
            self._check(waited)
            # Where there are more ranks than processors, the others need this one.
            if waited < 0.02:
                os.sched_yield()
            else:
                time.sleep(0.0005)

    def _check(self, waited: float) -> None:
        """Refuse to wait for what will not come."""
        if self._stopped.any():
            raise RuntimeError("a rank has stopped")
        if waited > self._timeout:
            raise RuntimeError(f"a rank has not answered for {waited:.0f} s")
        if waited > 0.02 and not all(map(_lives, self._processes.tolist())):
            raise RuntimeError("the process of a rank is gone")


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def can_be_shared(tensors: Sequence[th.Tensor]) -> bool:
    """Whether tensors are contiguous, on the CPU, and of one type that NumPy has.

    >>> can_be_shared([th.zeros(2), th.zeros(3, 3)]), can_be_shared([th.zeros(3, 3)[:, 0]])
    (True, False)
    """
    dtype = tensors[0].dtype
    return dtype is not th.bfloat16 and all(
        t.is_cpu and t.dtype is dtype and t.is_contiguous() for t in tensors
    )


def share_memory(group: Any, n_bytes: int, timeout: float) -> SharedSum | None:
    """Sums of arrays of so many bytes, if all ranks are on one machine; all ranks call this.

    :param group: The ranks, a :class:`~sb3_policyflow.distributed.group.ProcessGroup`.
    :param n_bytes: Bytes of an array.
    :param timeout: Seconds to wait for a rank that lives.
    """
    row = -(-n_bytes // LINE) * LINE
    length = (group.size + 1) * LINE + 2 * group.size * row
    token = uuid.uuid4().bytes
    file = _created(token, length) if group.rank == 0 and IS_ORDERED else None
    try:
        path, token = group.from_first((file, token))
        memory = None if path is None else _opened(path, token, length)
        everyone = all(group.gather(memory is not None))
    finally:
        if file is not None:
            os.unlink(file)  # it lives as long as the ranks do
    if not everyone or memory is None:
        return None
    shared = SharedSum(memory, group.rank, group.size, timeout)
    group.gather(None)  # no one counts before all have written their process
    return shared


def _created(token: bytes, length: int) -> str | None:
    """A file in memory that begins with a token; None where there is no such folder or room."""
    try:
        descriptor, path = tempfile.mkstemp(prefix="sb3_policyflow_", dir=FOLDER)
    except OSError:
        return None
    with os.fdopen(descriptor, "r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, length)
        except OSError:
            os.unlink(path)
            return None
        file.write(token)
    return path


def _opened(path: str, token: bytes, length: int) -> mmap.mmap | None:
    """The memory behind a file, if it is the one with this token."""
    try:
        with open(path, "r+b") as file:
            memory = mmap.mmap(file.fileno(), length)
    except OSError:
        return None
    return memory if memory[: len(token)] == token else None
