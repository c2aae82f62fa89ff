"""The processes of the rivals, as the command has them."""

import json
import os
import subprocess
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

from sb3_policyflow.benchmark.speed.rivals.settings import RIVALS

WORKER = "sb3_policyflow.benchmark.speed.rivals.worker"
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "NPROC",  # XLA's
)
VARIABLES = {
    "CUDA_VISIBLE_DEVICES": "",
    "JAX_PLATFORMS": "cpu",
    "TORCHINDUCTOR_COMPILE_THREADS": "1",  # no processes that stay
}


class RivalError(RuntimeError):
    """A rival does not train; the message says why, and what to do."""


@dataclass(frozen=True)
class Iteration:
    """How long one iteration took.

    :param seconds: In all.
    :param cpu_seconds: Of processor time, of all threads.
    :param others: How many cores other programs kept busy meanwhile; None where it is not known.
    """

    seconds: float
    cpu_seconds: float
    others: float | None


class Process:
    """One rival, which trains for an iteration when it is told to.

    It has as many cores as it may have threads, and all libraries are told that number.

    :param name: The rival, a key of ``RIVALS``.
    :param setting: The setting, a key of ``SETTINGS``.
    :param threads: Number of threads.
    :param python: The interpreter.
    :raises RivalError: If it does not start.
    """

    def __init__(self, name: str, setting: str, threads: int, python: str) -> None:
        self.name, self.python = name, python
        variables = {variable: str(threads) for variable in THREAD_VARIABLES}
        try:
            self._process = subprocess.Popen(
                [python, "-m", WORKER, name, setting, str(threads)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=os.environ | variables | VARIABLES,
                text=True,
                errors="replace",
            )
        except OSError as error:
            raise RivalError(str(error)) from error
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self._process.pid, cores()[:threads])
        pipes: Any = self._process.stdin, self._process.stdout, self._process.stderr
        self._requests, self._answers, errors = pipes
        self._last_words: deque[str] = deque(maxlen=1)
        self._reader = Thread(target=self._last_words.extend, args=(errors,), daemon=True)
        self._reader.start()
        self.versions: dict[str, str | None] = self._answer()["versions"]

    def iteration(self) -> Iteration:
        """Let it train for one iteration.

        :raises RivalError: If it fails.
        """
        busy, start = busy_seconds(), time.perf_counter()
        with suppress(BrokenPipeError):  # it has ended: the answer will say so
            print(file=self._requests, flush=True)
        answer = self._answer()
        wall = time.perf_counter() - start
        cpu = answer["cpu_seconds"]
        others = None if busy is None else max(0.0, (busy_seconds() - busy - cpu) / wall)
        return Iteration(answer["seconds"], cpu, others)

    def _answer(self) -> dict[str, Any]:
        line = self._answers.readline()
        answer: dict[str, Any] = json.loads(line) if line else {"missing": True}
        if "seconds" in answer or "versions" in answer:
            return answer
        self.close()
        what = answer.get("error") or "".join(self._last_words).strip() or "it has ended"
        package = RIVALS[self.name].package
        hint = f"; if it is not installed: {self.python} -m pip install {package}"
        raise RivalError(what + hint * answer["missing"])

    def close(self) -> None:
        """End it."""
        self._requests.close()
        self._process.wait()
        self._reader.join(timeout=5)
        self._answers.close()


def cores() -> list[int]:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def busy_seconds() -> Any:
    """Processor time that all programs of the machine have taken; None where it is not known."""
    path = Path("/proc/stat")
    if not path.is_file():
        return None
    user, nice, system, _, _, irq, soft, *_ = map(int, path.read_text().split()[1:9])
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")
