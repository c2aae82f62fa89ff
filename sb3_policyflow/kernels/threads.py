"""Rows shared out among threads.

They are other threads than those of PyTorch, whose OpenMP keeps them spinning for some milliseconds
behind each of its operations, on the cores that these threads need. With
``OMP_WAIT_POLICY=passive`` in the environment it lets them sleep: on two cores that makes
PolicyFlow's ``train()`` on MultiGoal take 0.74 of its time, see :mod:`sb3_policyflow.kernels`.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch as th

MIN_FLOPS_PER_THREAD = 4_000_000
"""Multiplications for which it pays to wake another thread."""


def n_parts(n_rows: int, flops_per_row: int) -> int:
    """In how many parts to do some work.

    :param n_rows: How many rows there are.
    :param flops_per_row: Multiplications for each.
    """
    return max(1, min(th.get_num_threads(), n_rows * flops_per_row // MIN_FLOPS_PER_THREAD, n_rows))


def in_parts(n_rows: int, parts: int, run: Callable[[int, int, int], None]) -> None:
    """Call ``run(part, start, stop)`` for parts of the rows, each on a thread of its own.

    :param n_rows: How many rows there are.
    :param parts: In how many parts.
    :param run: Works on some of the rows, for the most part without Python's global lock.
    """
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
