"""The process of one rival: ``python -m ...worker RIVAL SETTING THREADS``.

Each line on the standard input asks for one iteration. Each line on the standard output is an
answer in JSON: first the versions of what trains, then the seconds of each iteration and the
processor time of this process, or the error that ended it. What libraries print goes to stderr.
"""

import importlib
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

from sb3_policyflow.benchmark.speed.rivals import adapters
from sb3_policyflow.benchmark.speed.rivals.settings import RIVALS, SETTINGS


def serve(requests: TextIO, answer: Callable[[dict[str, Any]], None], argv: list[str]) -> None:
    """Train as often as asked.

    :param requests: Where lines come from.
    :param answer: Takes the answers.
    :param argv: Rival, setting and threads.
    """
    name, setting, threads = argv
    try:
        make = _adapter(name, int(threads))
        train = make(SETTINGS[setting])
        answer({"versions": _versions(name)})
        for _ in requests:
            wall, cpu = time.perf_counter(), time.process_time()
            train()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            answer({"seconds": wall, "cpu_seconds": cpu})
    except Exception as error:  # the command says it, and goes on without this rival
        missing = isinstance(error, ModuleNotFoundError)
        answer({"error": f"{type(error).__name__}: {error}", "missing": missing})


def _adapter(name: str, threads: int) -> Any:
    import torch as th

    th.set_num_threads(threads)
    return importlib.import_module(f"{adapters.__name__}.{RIVALS[name].module}").make


def _versions(name: str) -> dict[str, str | None]:
    from importlib.metadata import PackageNotFoundError, version

    from sb3_policyflow.benchmark.measure.provenance import versions

    found = versions()
    try:
        return {**found, "rival": version(RIVALS[name].package)}
    except PackageNotFoundError:  # this package, from a checkout that is not installed
        return {**found, "rival": found["sb3_policyflow"]}


def main() -> None:
    """Serve the standard input and output."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    serve(sys.stdin, lambda what: print(json.dumps(what), file=answers, flush=True), sys.argv[1:])


if __name__ == "__main__":
    main()
