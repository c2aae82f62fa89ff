"""Environment steps per second of the vectorized environments, as a training sees them.

Each is made as rl_zoo3 would make it, in one process, and takes random actions. The first reset and
step, which may compile, are timed apart, and so is a later reset: an episode of 1000 steps costs
one of them too. For figures to report, let nothing else run on the machine.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_policyflow.benchmark.errors import at_least, require_env
from sb3_policyflow.benchmark.measure.provenance import machine
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.envs import PLAYGROUND, PLAYGROUND_TASKS
from sb3_policyflow.envs.native import has_own_vectorization, make_native_vec_env

DEFAULT_IDS = tuple(f"{PLAYGROUND}{task}-v0" for task in PLAYGROUND_TASKS)
DEFAULT_SIZES = (64, 256, 1024)
N_ROUNDS = 5


@dataclass(frozen=True)
class Timing:
    """How fast one environment is.

    :param env_id: Its id.
    :param num_envs: How many were stepped at once.
    :param steps_per_second: Environment steps in a second: the median over the rounds.
    :param rounds: Environment steps in a second of each round.
    :param steps_per_cpu_second: Environment steps in a second of processor time, of all cores.
    :param first_seconds: What the first reset and the first step took, compilation included.
    :param reset_seconds: What a later reset of all environments took.
    """

    env_id: str
    num_envs: int
    steps_per_second: float
    rounds: list[float]
    steps_per_cpu_second: float
    first_seconds: float
    reset_seconds: float


def time_environment(env_id: str, num_envs: int, seconds: float) -> Timing:
    """Time one environment.

    :param seconds: How long to step it for.
    :raises BenchmarkError: If there is no such environment, or the extra that it needs is missing.
    """
    require_env(env_id)
    is_native = has_own_vectorization(gym.spec(env_id))
    vec_env_cls: Any = make_native_vec_env if is_native else DummyVecEnv
    env = make_vec_env(env_id, num_envs, seed=0, vec_env_cls=vec_env_cls)
    actions = np.stack([env.action_space.sample() for _ in range(num_envs)])
    first_seconds = _seconds(env.reset) + _seconds(lambda: env.step(actions))
    reset_seconds = _seconds(env.reset)
    cpu_start = time.process_time()
    rounds = [_steps_in(env, actions, seconds / N_ROUNDS) for _ in range(N_ROUNDS)]
    cpu_seconds = time.process_time() - cpu_start
    env.close()
    rates = [steps / taken for steps, taken in rounds]
    return Timing(
        env_id,
        num_envs,
        statistics.median(rates),
        rates,
        sum(steps for steps, _ in rounds) / cpu_seconds,
        first_seconds,
        reset_seconds,
    )


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _steps_in(env: VecEnv, actions: np.ndarray, seconds: float) -> tuple[int, float]:
    """Environment steps taken in about so many seconds, and the seconds that they took."""
    start = time.perf_counter()
    steps = 0
    while time.perf_counter() - start < seconds:
        env.step(actions)
        steps += env.num_envs
    return steps, time.perf_counter() - start


def speed_table(timings: Sequence[Timing]) -> str:
    """A row for each environment, a column for each size, and the times of the largest.

    Steps per second of time, and in brackets per second of processor time, which says more where
    the machine had something else to do.
    """
    sizes = sorted({timing.num_envs for timing in timings})
    largest = f"{sizes[-1]} environments"
    header = ["steps per second", *map(str, sizes), f"first step, s, {largest}", "reset, ms"]
    rows = []
    for env_id in dict.fromkeys(timing.env_id for timing in timings):
        found = {timing.num_envs: timing for timing in timings if timing.env_id == env_id}
        rates = [_rates(found[n]) if n in found else "-" for n in sizes]
        last = found[max(found)]
        rows.append(
            [env_id, *rates, f"{last.first_seconds:.0f}", f"{1000 * last.reset_seconds:,.0f}"]
        )
    return markdown_table(header, rows)


def _rates(timing: Timing) -> str:
    return f"{timing.steps_per_second:,.0f} ({timing.steps_per_cpu_second:,.0f})"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("ids", nargs="*", help="environments; default: the ten of Playground")
    parser.add_argument("--num-envs", type=at_least(1), nargs="+", default=DEFAULT_SIZES)
    parser.add_argument(
        "--seconds", type=at_least(0.01, float), default=3.0, help="of steps each; default: 3"
    )
    parser.add_argument("--out", type=Path, help="a JSON file for all figures")


def main(arguments: argparse.Namespace) -> int:
    """Measure, write the table to the terminal and the figures to a file."""
    timings = []
    for env_id in arguments.ids or DEFAULT_IDS:
        for num_envs in arguments.num_envs:
            timings.append(time_environment(env_id, num_envs, arguments.seconds))
            rate = timings[-1].steps_per_second
            print(f"{env_id} {num_envs}: {rate:,.0f} steps/s", file=sys.stderr)
    print(speed_table(timings))
    if arguments.out is not None:
        figures = {"machine": machine(), "timings": [asdict(timing) for timing in timings]}
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        print(f"Wrote {arguments.out}.")
    return 0
