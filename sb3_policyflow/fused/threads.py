"""Rows shared out among threads."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch as th

WORTHWHILE = 2_000_000
"""Multiplications for which it pays to wake another thread."""


def in_parts(n_rows: int, work_per_row: int, run: Callable[[int, int], None]) -> None:
    """Call ``run(start, stop)`` for parts of the rows, on as many threads as torch may use.

    :param n_rows: How many rows there are.
    :param work_per_row: Multiplications for each.
    :param run: Works on some of the rows, without Python's global lock.
    """
    n_parts = min(th.get_num_threads(), n_rows * work_per_row // WORTHWHILE, n_rows)
    if n_parts < 2:
        run(0, n_rows)
        return
    bounds = [n_rows * part // n_parts for part in range(n_parts + 1)]
    others = [_pool().submit(run, *bounds[part : part + 2]) for part in range(1, n_parts)]
    run(*bounds[:2])
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="sb3_policyflow")


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork.
    os.register_at_fork(after_in_child=_pool.cache_clear)
