"""Train algorithms in environments with several seeds; what has been run is not run again."""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

import gymnasium as gym
from tqdm import tqdm

from sb3_policyflow.benchmark.results import Cell, ResultsError
from sb3_policyflow.envs import ensure_registered

DEFAULT_FOLDER = Path("benchmark-results")


def run_cells(
    cells: Iterable[Cell], folder: Path, n_jobs: int = 1, n_threads: int = 1
) -> list[Cell]:
    """Run the cells that have not been run, each in a process of its own.

    What a process says goes to ``NAME/ENV/seed-N.log``, which stays only if it fails.

    :param cells: What is wanted.
    :param folder: Where results are and go.
    :param n_jobs: Processes at a time.
    :param n_threads: Threads of each.
    :return: The cells that failed.
    :raises ResultsError: If a cell has been run with other settings.
    """
    cells = list(cells)
    missing = [cell for cell in cells if not cell.is_done(folder)]
    failed = []
    with (
        tqdm(total=len(cells), initial=len(cells) - len(missing), unit="cell") as bar,
        ThreadPoolExecutor(n_jobs) as pool,
    ):
        jobs = {pool.submit(_run_cell, cell, folder, n_threads): cell for cell in missing}
        for job in as_completed(jobs):
            cell = jobs[job]
            if not job.result():
                failed.append(cell)
                bar.write(f"failed: see {cell.path(folder, '.log')}", file=sys.stderr)
            bar.set_postfix_str(f"{cell.name} {cell.env} seed {cell.seed}")
            bar.update()
    return failed


def _run_cell(cell: Cell, folder: Path, n_threads: int) -> bool:
    """Run one cell and wait for it; whether all went well."""
    log = cell.path(folder, ".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "sb3_policyflow.benchmark", "cell"]
    command += [json.dumps(asdict(cell)), str(folder), "--threads", str(n_threads)]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(n_threads))
    with open(log, "w", encoding="utf-8") as file:
        outcome = subprocess.run(
            command, stdout=file, stderr=subprocess.STDOUT, env=os.environ | threads, check=False
        )
        # A process that was killed says nothing itself; its code is minus the signal.
        file.write(f"exit code {outcome.returncode}\n")
    if outcome.returncode == 0:
        log.unlink()
    return outcome.returncode == 0


def report_failures(failed: Sequence[Cell]) -> int:
    """Say what failed; the exit code of the command."""
    for cell in failed:
        sys.stderr.write(f"failed: {cell.name} {cell.env} seed {cell.seed}\n")
    return 1 if failed else 0


def require_env(env_id: str) -> None:
    """See whether there is an environment, before trainings are started in it.

    :raises ResultsError: If there is none, or what it needs is missing.
    """
    try:
        ensure_registered(env_id)
        gym.spec(env_id)
    except gym.error.Error as error:
        raise ResultsError(str(error)) from error


def add_running_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what every command that trains takes."""
    numbers = {
        "jobs": (1, "processes at a time"),
        "threads": (1, "threads of each"),
        "evaluations": (10, "over the training"),
        "episodes": (20, "of an evaluation"),
    }
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="default: 0")
    for name, (default, text) in numbers.items():
        parser.add_argument(
            f"--{name}", type=int, default=default, help=f"{text}; default: %(default)s"
        )


def main(argv: list[str]) -> int:
    """Run every combination of algorithms, environments and seeds."""
    # Only this command takes it; the figures' commands, which run cells too, start without rl_zoo3.
    from rl_zoo3.utils import StoreDict

    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.benchmark run", description=__doc__
    )
    parser.add_argument("--algos", nargs="+", default=["policyflow", "fpo", "dppo", "ppo"])
    parser.add_argument("--envs", nargs="+", required=True, help="ids of environments")
    parser.add_argument("--steps", type=float, required=True, help="environment steps, say 1e6")
    parser.add_argument("--out", type=Path, default=DEFAULT_FOLDER, help="folder of the results")
    parser.add_argument(
        "--hyperparams",
        nargs="+",
        action=StoreDict,
        default={},
        metavar="NAME:VALUE",
        help="what differs from the YAML files, as rl_zoo3 takes it, for example n_epochs:4",
    )
    add_running_arguments(parser)
    arguments = parser.parse_args(argv)
    for env in arguments.envs:
        require_env(env)
    cells = [
        Cell(
            algo,
            algo,
            env,
            seed,
            int(arguments.steps),
            arguments.hyperparams,
            n_evaluations=arguments.evaluations,
            n_episodes=arguments.episodes,
        )
        for env in arguments.envs
        for seed in arguments.seeds
        for algo in arguments.algos
    ]
    return report_failures(run_cells(cells, arguments.out, arguments.jobs, arguments.threads))
