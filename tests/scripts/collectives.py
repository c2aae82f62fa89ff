"""Measures what ranks pay for agreeing.

torchrun --nproc-per-node 2 tests/scripts/collectives.py

Medians of the time of an all-reduce of so many bytes, of one moment exchange (two numbers of each
rank), and of one exchange of objects between updates.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import torch as th

from sb3_policyflow.distributed.group import process_group


def microseconds(call: Callable[[], object], repetitions: int = 300) -> float:
    """The median time of a call, after some to warm up."""
    times = []
    for _ in range(repetitions + 20):
        began = time.perf_counter()
        call()
        times.append(1e6 * (time.perf_counter() - began))
    return median(times[20:])


def main() -> None:
    """Print a table on rank 0."""
    th.set_num_threads(1)
    group = process_group()
    group.connect(th.device("cpu"))
    lines = []
    for n_numbers in (13_000, 50_000, 250_000, 1_000_000, 4_000_000):
        parameter = th.nn.Parameter(th.zeros(n_numbers))
        parameter.grad = th.zeros(n_numbers)
        repetitions = 300 if n_numbers < 1_000_000 else 20
        average = partial(group.average_gradients, [parameter], 0.0)
        spent = microseconds(average, repetitions)
        lines.append(f"gradients of {4 * n_numbers / 1e6:.2f} MB: {spent:.0f} us")
    values = th.zeros(64)
    lines.append(
        f"moments of the advantages: {microseconds(lambda: group.mean_std(values)):.0f} us"
    )
    report = {"numbers": bytes(20_000)}
    lines.append(f"20 kB of objects: {microseconds(lambda: group.gather(report), 50):.0f} us")
    if group.rank == 0:
        sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
