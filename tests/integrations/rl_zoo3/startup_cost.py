"""What the package costs at interpreter start; run this file.

Medians over interpreters that are started in turns with and without the package installed, in
environments that are otherwise the same: the time until the interpreter has ended, which wants an
idle machine, and the processor time it took, which does not.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from installation import Environment, build

CODES = {"interpreter start": "pass", "import gymnasium": "import gymnasium"}


class Milliseconds(NamedTuple):
    wall: float
    processor: float


def measure(environment: Environment, code: str) -> Milliseconds:
    start = time.perf_counter()
    process = subprocess.Popen([environment.python, "-c", code])
    _, process.returncode, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    assert process.returncode == 0
    return Milliseconds(1e3 * wall, 1e3 * (usage.ru_utime + usage.ru_stime))


def medians(environments: list[Environment], code: str, repeats: int) -> list[Milliseconds]:
    """Medians in each environment; the first round, which fills caches, does not count."""
    rounds = [[measure(each, code) for each in environments] for _ in range(repeats + 1)][1:]
    return [
        Milliseconds(*(statistics.median(values) for values in zip(*costs, strict=True)))
        for costs in zip(*rounds, strict=True)
    ]


def report(repeats: int) -> str:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        without = Environment.create(folder / "without")
        installed = Environment.create(folder / "with").install(build("wheel", folder))
        lines = [f"{'median of ' + str(repeats):32}{'without':>10}{'with':>10}{'difference':>12}"]
        for title, code in CODES.items():
            costs = medians([without, installed], code, repeats)
            for kind, (before, after) in zip(
                Milliseconds._fields, zip(*costs, strict=True), strict=True
            ):
                figures = f"{before:7.2f} ms{after:7.2f} ms{after - before:9.2f} ms"
                lines.append(f"{title + ', ' + kind:32}{figures}")
        return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200)
    sys.stdout.write(report(parser.parse_args().repeats))
