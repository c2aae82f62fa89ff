"""Worker processes of a ``SubprocVecEnv`` that may die."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import connection

from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv


def wait_for_workers(venv: VecEnv) -> None:
    """Wait until every worker process has answered, or one has died.

    A dead worker's pipe tells its end, except under the start method "fork": there the other
    workers have inherited it and hold it open, and SB3 would wait for an answer for ever.

    :param venv: An environment without wrappers; nothing happens if it has no such workers.
    :raises EOFError: If a worker has died.
    """
    if not isinstance(venv, SubprocVecEnv):
        return
    for remote, process in zip(venv.remotes, venv.processes, strict=True):
        forked = type(process).__name__ == "ForkProcess"
        if forked and process.sentinel in connection.wait([remote, process.sentinel]):
            raise EOFError(f"{process.name} has ended.")


@contextmanager
def watch_workers(venv: VecEnv, timestep: Callable[[], int]) -> Iterator[None]:
    """A block that uses an environment, and says which of its worker processes has died.

    :param venv: The environment, with its wrappers.
    :param timestep: Timesteps so far, for the message.
    :raises RuntimeError: If a worker has died. The others are ended too, because a
        ``SubprocVecEnv`` can neither replace one nor close without it.
    """
    try:
        yield
    except (EOFError, ConnectionError) as error:
        env = venv.unwrapped
        deaths = _deaths(env) if isinstance(env, SubprocVecEnv) else ""
        if not deaths:
            raise
        _end_all(env)
        raise RuntimeError(
            f"A worker process of SubprocVecEnv has died after timestep {timestep()}: {deaths}. If "
            "its environment raised, the traceback is printed above. The model can be saved; make "
            "the environments anew and give them to set_env to go on."
        ) from error


def _deaths(env: SubprocVecEnv) -> str:
    """Which workers have died, and how; nothing if none has."""
    # A pipe may be closed a moment before its process is gone.
    ended = connection.wait([process.sentinel for process in env.processes], timeout=1.0)
    deaths = []
    for index, process in enumerate(env.processes):
        if process.sentinel in ended:
            process.join(timeout=1.0)
            deaths.append(f"environment {index} ({_cause(process.exitcode)})")
    return ", ".join(deaths)


def _cause(exitcode: int | None) -> str:
    """How a process ended, in words.

    >>> _cause(1), _cause(-9)
    ('exit code 1', 'killed by SIGKILL')
    """
    if exitcode is not None and exitcode < 0:
        return f"killed by {signal.Signals(-exitcode).name}"
    return f"exit code {exitcode}"


def _end_all(env: VecEnv) -> None:
    assert isinstance(env, SubprocVecEnv)
    for process in env.processes:
        process.terminate()
    for process, remote in zip(env.processes, env.remotes, strict=True):
        process.join(timeout=1.0)
        remote.close()
    env.closed = True
