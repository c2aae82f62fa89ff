"""Worker processes of a ``SubprocVecEnv`` that may die."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import Pipe, connection
from threading import Thread

from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv


class FirstDeath:
    """While a block runs, ends all workers of an environment when the first has died.

    A dead worker's pipe tells its end, and SB3 stops waiting for its answer, except under the start
    method "fork": there the other workers have inherited the pipe and hold it open. Ending them
    closes it.

    :param env: The environment.
    """

    def __init__(self, env: SubprocVecEnv) -> None:
        self._processes = env.processes
        self._end, self._ended = Pipe()
        self._thread = Thread(target=self._wait, name="sb3_policyflow workers", daemon=True)
        self.indices: list[int] = []
        """Which workers died first."""

    def _wait(self) -> None:
        sentinels = [process.sentinel for process in self._processes]
        dead = connection.wait([*sentinels, self._ended])
        self.indices = [index for index, one in enumerate(sentinels) if one in dead]
        if self.indices and self._ended not in dead:
            for process in self._processes:
                process.terminate()

    def __enter__(self) -> "FirstDeath":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.send(None)
        self._thread.join()
        self._end.close()
        self._ended.close()


@contextmanager
def watch_workers(venv: VecEnv, timestep: Callable[[], int]) -> Iterator[None]:
    """A block that uses an environment, and says which of its worker processes has died.

    :param venv: The environment, with its wrappers.
    :param timestep: Timesteps so far, for the message.
    :raises RuntimeError: If a worker has died. The others are ended too, because a
        ``SubprocVecEnv`` can neither replace one nor close without it.
    """
    env = venv.unwrapped
    if not isinstance(env, SubprocVecEnv):
        yield
        return
    first = FirstDeath(env)
    try:
        with first:
            yield
    except (EOFError, ConnectionError) as error:
        deaths = _deaths(env, first.indices)
        if not deaths:
            raise
        _end_all(env)
        raise RuntimeError(
            f"A worker process of SubprocVecEnv has died after timestep {timestep()}: {deaths}. If "
            "its environment raised, the traceback is printed above. The model can be saved; make "
            "the environments anew and give them to set_env to continue."
        ) from error


def _deaths(env: SubprocVecEnv, first: list[int]) -> str:
    """Which workers have died, and how; nothing if none has."""
    if not first:
        # A pipe may be closed a moment before its process is gone.
        ended = connection.wait([process.sentinel for process in env.processes], timeout=1.0)
        first = [i for i, process in enumerate(env.processes) if process.sentinel in ended]
    for index in first:
        env.processes[index].join(timeout=1.0)
    causes = (_cause(env.processes[index].exitcode) for index in first)
    return ", ".join(f"environment {i} ({cause})" for i, cause in zip(first, causes, strict=True))


def _cause(exitcode: int | None) -> str:
    """How a process ended, in words.

    >>> _cause(1), _cause(-9)
    ('exit code 1', 'killed by SIGKILL')
    """
    if exitcode is not None and exitcode < 0:
        return f"killed by {signal.Signals(-exitcode).name}"
    return f"exit code {exitcode}"


def _end_all(env: SubprocVecEnv) -> None:
    for process in env.processes:
        process.terminate()
    for process, remote in zip(env.processes, env.remotes, strict=True):
        process.join(timeout=1.0)
        remote.close()
    env.closed = True
