"""Starts several ranks: with torchrun, as a user does, or from a server that has imported."""

import multiprocessing
import os
import pickle
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
LIMIT = 120


def torchrun(n_ranks: int, *arguments: object, **options: object) -> Any:
    """Run a script or module with several ranks, and wait for the end.

    :param n_ranks: How many.
    :param arguments: The script, or "-m" and the module, and its arguments.
    :param options: Options of torchrun, such as ``max_restarts``.
    :return: The completed process, with its output.
    """
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
    command += [f"--nproc-per-node={n_ranks}", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command,
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )


def run_ranks(n_ranks: int, function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """Call a function in several ranks, and return what it returns in each.

    :param n_ranks: How many.
    :param function: A function that can be imported.
    :param arguments: Its arguments.
    :return: The results in order; the exception, where it raised; None, where it was killed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sb3_policyflow", "stable_baselines3.common.env_util"])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / str(rank) for rank in range(n_ranks)]
        processes = [
            context.Process(target=_be_rank, args=(rank, n_ranks, port, file, function, arguments))
            for rank, file in enumerate(files)
        ]
        for process in processes:
            process.start()
        for process in processes:
            process.join(LIMIT)
        hanging = [process for process in processes if process.is_alive()]
        for process in hanging:
            process.kill()
        assert not hanging, "some ranks did not end"
        return [pickle.loads(file.read_bytes()) if file.exists() else None for file in files]


def _be_rank(
    rank: int,
    n_ranks: int,
    port: int,
    file: Path,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
) -> None:
    import torch as th

    th.set_num_threads(1)
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE=str(n_ranks), LOCAL_WORLD_SIZE=str(n_ranks)
    )
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    try:
        result = function(*arguments)
    except Exception as error:
        result = f"{type(error).__name__}: {error}"
    file.write_bytes(pickle.dumps(result))
    if th.distributed.is_initialized():
        th.distributed.barrier()  # rank 0 has the store, and goes last
        th.distributed.destroy_process_group()
