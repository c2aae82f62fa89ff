"""Rows shared out among threads, and torch's own threads asleep meanwhile.

Threads of OpenMP, which torch starts for large tensors, keep a core busy for some milliseconds
behind each operation, in case there is more to do. The threads here would have to share that core
with them. So where kernels do the bulk of the work, torch's part of it runs on the calling thread,
see :func:`kernels_have_the_cores`.
"""

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch as th

MIN_FLOPS_PER_THREAD = 4_000_000
"""Multiplications for which it pays to wake another thread."""
OPENMP = ("libtorch_cpu.so", "libtorch_cpu.dylib", "libiomp5md.dll")
"""Libraries of torch that lead to the OpenMP that it uses, on Linux, macOS and Windows."""


class _Lent(threading.local):
    """How many threads of torch this thread has lent to kernels; 0 for none."""

    n_threads = 0


_lent = _Lent()


@contextmanager
def kernels_have_the_cores() -> Iterator[None]:
    """A block in which kernels have the threads that the user gave to torch, and torch has one.

    OpenMP keeps this number for each thread that starts operations: no other one notices.
    """
    n_threads, set_threads = th.get_num_threads(), _setter_of_openmp()
    if n_threads == 1 or set_threads is None:
        yield
        return
    set_threads(1)
    _lent.n_threads = n_threads
    try:
        yield
    finally:
        _lent.n_threads = 0
        if th.get_num_threads() == 1:  # else somebody has set it meanwhile
            set_threads(n_threads)


@cache
def _setter_of_openmp() -> Callable[[int], object] | None:
    """``omp_set_num_threads`` of the OpenMP that torch uses, if it uses one."""
    for name in OPENMP:
        path = Path(th.__file__).parent / "lib" / name
        try:
            # A library is searched with those that it depends on.
            set_threads: Callable[[int], object] = ctypes.CDLL(str(path)).omp_set_num_threads
        except (OSError, AttributeError):
            continue
        return set_threads
    return None


def n_usable_threads() -> int:
    """Threads that kernels may run on: those that the user gave to torch, but one for each core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(max(_lent.n_threads, th.get_num_threads()), cores or 1)


def n_parts(n_rows: int, flops_per_row: int) -> int:
    """In how many parts to do some work.

    :param n_rows: How many rows there are.
    :param flops_per_row: Multiplications for each.
    """
    most = min(n_rows * flops_per_row // MIN_FLOPS_PER_THREAD, n_rows)
    return 1 if most < 2 else min(n_usable_threads(), most)


def in_parts(n_rows: int, parts: int, run: Callable[[int, int, int], None]) -> None:
    """Call ``run(part, start, stop)`` for parts of the rows, each on a thread of its own.

    :param n_rows: How many rows there are.
    :param parts: In how many parts.
    :param run: Works on some of the rows, for the most part without Python's global lock.
    """
    if parts == 1:
        run(0, 0, n_rows)
        return
    bounds = [n_rows * part // parts for part in range(parts + 1)]
    others = []
    for part in range(1, parts):
        try:
            others.append(_pool().submit(run, part, *bounds[part : part + 2]))
        except RuntimeError:  # noqa: PERF203
            # Python starts no thread behind the end of its main thread, which others may outlive.
            run(part, *bounds[part : part + 2])
    run(0, *bounds[:2])
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="sb3_policyflow")


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork.
    os.register_at_fork(after_in_child=_pool.cache_clear)
