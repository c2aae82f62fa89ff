"""Train algorithms in environments with several seeds; what has been run is not run again."""

import argparse
import os
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from tqdm import tqdm

from sb3_policyflow.benchmark.errors import at_least, require_env
from sb3_policyflow.benchmark.results import DEFAULT_FOLDER, PROGRESS, Run
from sb3_policyflow.integrations.rl_zoo3.experiment import check_hyperparams

EXIT = "exit code "
"""With what the last line of a training's log begins."""


def run_all(
    runs: Iterable[Run],
    folder: Path,
    n_jobs: int = 1,
    n_threads: int = 1,
    agents: Path | None = None,
) -> list[Run]:
    """Run what has not been run, each training in a process of its own.

    What a process says goes to ``NAME/ENV/seed-N.log``, which stays only if it fails.

    :param runs: What is wanted.
    :param folder: Where results are and go.
    :param n_jobs: Processes at a time.
    :param n_threads: Threads of each.
    :param agents: Where trained agents go; None to keep none.
    :return: The runs that failed.
    :raises BenchmarkError: If one has been run with other settings, or could not be written.
    """
    runs = list(runs)
    missing = [run for run in runs if not run.is_done(folder)]
    failed = []
    with (
        tqdm(total=len(runs), initial=len(runs) - len(missing), unit="run") as bar,
        steps_of_runs(missing, folder, bar),
        ThreadPoolExecutor(n_jobs) as pool,
    ):
        jobs = {pool.submit(_succeeds, run, folder, n_threads, agents): run for run in missing}
        for job in as_completed(jobs):
            run = jobs[job]
            if not job.result():
                failed.append(run)
                bar.write(f"failed: see {run.path(folder, '.log')}", file=sys.stderr)
            bar.update()
    return failed


@contextmanager
def steps_of_runs(
    runs: Iterable[Run], folder: Path, bar: "tqdm[Any]", every: float = 2.0
) -> Iterator[None]:
    """Show how far the trainings are that go on, behind the bar that counts those that are done.

    :param runs: The trainings.
    :param folder: Where their logs are.
    :param bar: The bar.
    :param every: Seconds from one look at the logs to the next.
    """
    done = threading.Event()

    def show() -> None:
        while not done.wait(every):
            shares = [f"{run}: {share}" for run in runs if (share := _share_of_steps(run, folder))]
            bar.set_postfix_str(", ".join(shares))

    watcher = threading.Thread(target=show, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def _share_of_steps(run: Run, folder: Path) -> str:
    """How far a training is by its log; empty if it does not go on."""
    log = run.path(folder, ".log")
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    shares = [line.removeprefix(PROGRESS) for line in lines if line.startswith(PROGRESS)]
    return "" if not lines or lines[-1].startswith(EXIT) else (shares or ["starting"])[-1]


def _succeeds(run: Run, folder: Path, n_threads: int, agents: Path | None) -> bool:
    """Train in another process and wait for it; whether all went well."""
    log = run.path(folder, ".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "sb3_policyflow.benchmark", "train-one"]
    command += [run.as_json(), str(folder), "--threads", str(n_threads)]
    command += [] if agents is None else ["--agents", str(agents)]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(n_threads))
    with open(log, "w", encoding="utf-8") as file:
        outcome = subprocess.run(
            command, stdout=file, stderr=subprocess.STDOUT, env=os.environ | threads, check=False
        )
        # A process that was killed says nothing itself; its code is minus the signal.
        file.write(f"{EXIT}{outcome.returncode}\n")
    if outcome.returncode == 0:
        log.unlink()
    return outcome.returncode == 0


def run_and_report(runs: Iterable[Run], arguments: argparse.Namespace) -> int:
    """Run what has not been run, and say what came of it.

    :param runs: What is wanted.
    :param arguments: The options of :func:`add_running_arguments`.
    :return: The exit code of the command.
    """
    runs = list(runs)
    agents = getattr(arguments, "agents", None)  # not every command keeps them
    failed = run_all(runs, arguments.out, arguments.jobs, arguments.threads, agents)
    for run in failed:
        print(f"failed: {run}", file=sys.stderr)
    print(f"{len(runs) - len(failed)} of {len(runs)} results are in {arguments.out}.", flush=True)
    return 1 if failed else 0


def add_running_arguments(parser: argparse.ArgumentParser, out: Path) -> None:
    """Add what every command that trains takes.

    :param parser: The command's.
    :param out: Folder of the results, if not given.
    """
    parser.add_argument(
        "--out", type=Path, default=out, help="folder of the results; default: %(default)s"
    )
    parser.add_argument("--seeds", type=at_least(0), nargs="+", default=[0], help="default: 0")
    numbers = {
        "jobs": (1, "processes at a time"),
        "threads": (1, "threads of each"),
        "evaluations": (10, "over the training; one a rollout, if there are fewer rollouts"),
        "episodes": (20, "of an evaluation"),
    }
    for name, (default, text) in numbers.items():
        parser.add_argument(
            f"--{name}", type=at_least(1), default=default, help=f"{text}; default: %(default)s"
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    # Only this command takes them; the figures' commands, which train too, start without rl_zoo3.
    from rl_zoo3.utils import ALGOS, StoreDict

    algos = [name for name, algo in ALGOS.items() if issubclass(algo, OnPolicyAlgorithm)]
    default = ["policyflow", "fpo", "dppo", "ppo"]
    parser.add_argument(
        "--algos", nargs="+", choices=algos, default=default, help=f"default: {default}"
    )
    parser.add_argument("--envs", nargs="+", required=True, help="ids of environments")
    parser.add_argument(
        "--steps", type=at_least(1, float), required=True, help="environment steps, say 1e6"
    )
    parser.add_argument(
        "--hyperparams",
        nargs="+",
        action=StoreDict,
        default={},
        metavar="NAME:VALUE",
        help="what differs from the YAML files, as rl_zoo3 takes it, for example n_epochs:4",
    )
    parser.add_argument(
        "--agents",
        type=Path,
        metavar="FOLDER",
        help="keep the trained agents there, for rl_zoo3.enjoy -f FOLDER/seed-N",
    )
    add_running_arguments(parser, DEFAULT_FOLDER)


def main(arguments: argparse.Namespace) -> int:
    """Run every combination of algorithms, environments and seeds."""
    from rl_zoo3.utils import ALGOS

    for env in arguments.envs:
        require_env(env)
    for algo in arguments.algos:
        check_hyperparams(ALGOS[algo], arguments.hyperparams)
    runs = [
        Run(
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
    return run_and_report(runs, arguments)
