"""Time PolicyFlow and SB3's PPO, in turn and in one process.

Same environments, networks, batches and epochs. Ratios are PolicyFlow's time over PPO's. For
figures to report, let nothing else run on the machine.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch as th

from sb3_policyflow.benchmark.errors import BenchmarkError, at_least
from sb3_policyflow.benchmark.measure.provenance import machine
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.speed.rivals import command as rivals
from sb3_policyflow.benchmark.speed.settings import GROWTH, MAIN, halfcheetah, isaaclab
from sb3_policyflow.benchmark.speed.timing import PARTS, peak_memory, time_calls, time_setting

EMBEDDINGS = (64, 256, 512)
CHOICES = (*MAIN, "predict", "memory", "growth", "isaaclab")
DEFAULT = (*MAIN, "predict", "memory")


ACTIONS = {
    "deterministic": ("mode", True),
    'deterministic, with `deterministic_action="zero"`': ("zero", True),
    "drawn": ("mode", False),
}
"""Kinds of actions, with PolicyFlow's ``deterministic_action`` and whether they are so."""


def predict_times(repetitions: int) -> dict[str, Any]:
    """Prediction of one action for HalfCheetah-v5, as a robot or ``enjoy`` asks for it."""
    setting = halfcheetah()
    models = {name: make() for name, make in setting.makers.items()}
    env: Any = models["PPO"].env
    observation, figures = env.reset()[0], {}
    policy: Any = models["PolicyFlow"].policy
    for action, (policy.deterministic_action, deterministic) in ACTIONS.items():
        calls = {
            name: partial(model.predict, observation, deterministic=deterministic)
            for name, model in models.items()
        }
        seconds = time_calls(calls, repetitions)
        ratio = seconds["PolicyFlow"] / seconds["PPO"]
        figures[action] = {"seconds": seconds, "ratio": ratio}
    return figures


def memory_of(name: str, maker: str) -> float:
    """Peak memory in MiB of two iterations, in a process of their own."""
    command = [sys.executable, "-m", "sb3_policyflow.benchmark", "speed"]
    command += ["--memory-of", name, maker]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return float(output.split()[-1])


def measure_memory(name: str, maker: str) -> float:
    """Train for two iterations, and say how much memory this process has needed."""
    model = MAIN[name]().makers[maker]()
    model.learn(2 * model.n_steps * model.n_envs)
    return peak_memory()


def memory_figures() -> dict[str, dict[str, float]]:
    """Peak memory of each algorithm in each setting."""
    names = ("multigoal", "halfcheetah", "pendulum")
    return {name: {who: memory_of(name, who) for who in ("PolicyFlow", "PPO")} for name in names}


def growth_figures(repetitions: int) -> dict[str, list[dict[str, Any]]]:
    """Iterations while one thing grows."""
    return {
        what: [{"value": n, **time_setting(make(n), repetitions)} for n in values]
        for what, (make, values) in GROWTH.items()
    }


# Tables


def iterations_table(results: Sequence[dict[str, Any]]) -> str:
    """A row for each model: its median time, what it goes to, and the ratio to the last model."""
    rows = []
    for result in results:
        *_, last = result["seconds"]
        reference = result["seconds"][last]["total"]
        for name, seconds in result["seconds"].items():
            ratio = "" if name == last else f"**{seconds['total'] / reference:.2f}**"
            times = [f"{1000 * seconds[part]:.0f}" for part in ("total", *PARTS)]
            rows.append([result["title"], name, ratio, *times])
    return markdown_table(["", "", "ratio", "iteration, ms", *PARTS], rows)


def growth_table(what: str, results: Sequence[dict[str, Any]]) -> str:
    """A row for each value of what grows."""
    rows = [
        [
            str(result["value"]),
            *(f"{1000 * seconds['total']:.0f}" for seconds in result["seconds"].values()),
            f"{result['ratio']:.2f}",
        ]
        for result in results
    ]
    return markdown_table([what, "PolicyFlow, ms", "PPO, ms", "ratio"], rows)


def calls_table(figures: dict[str, Any]) -> str:
    """A row for each kind of action of ``predict``."""
    header = ["predict, one observation", "PolicyFlow, us", "PPO, us", "ratio"]
    rows = []
    for action, result in figures.items():
        times = [f"{1e6 * result['seconds'][name]:.0f}" for name in ("PolicyFlow", "PPO")]
        rows.append([action, *times, f"**{result['ratio']:.2f}**"])
    return markdown_table(header, rows)


def memory_table(results: dict[str, dict[str, float]]) -> str:
    """A row for each setting."""
    rows = []
    for name, mib in results.items():
        ratio = mib["PolicyFlow"] / mib["PPO"]
        rows.append([name, f"{mib['PolicyFlow']:.0f}", f"{mib['PPO']:.0f}", f"{ratio:.2f}"])
    return markdown_table(["peak memory", "PolicyFlow, MiB", "PPO, MiB", "ratio"], rows)


def measure(what: str, repetitions: int, device: str) -> tuple[Any, str]:
    """Figures and their table.

    :param what: One of ``CHOICES``.
    :param repetitions: How often to measure.
    :param device: Where "isaaclab" trains.
    """
    if what == "predict":
        calls = predict_times(repetitions)
        return calls, calls_table(calls)
    if what == "memory":
        memory = memory_figures()
        return memory, memory_table(memory)
    if what == "growth":
        growth = growth_figures(repetitions)
        return growth, "\n\n".join(growth_table(*item) for item in growth.items())
    if what == "isaaclab":
        sizes = [time_setting(isaaclab(size, device), repetitions) for size in EMBEDDINGS]
        return sizes, iterations_table(sizes)
    result = time_setting(MAIN[what](), repetitions)
    return result, iterations_table([result])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    choices, default = ", ".join(CHOICES), ", ".join(DEFAULT)
    what = f"of {choices}, or rivals alone; default: {default}"
    parser.add_argument("what", nargs="*", help=what)
    parser.add_argument("--repetitions", type=at_least(1), default=5, help="default: 5")
    parser.add_argument("--threads", type=at_least(1), help="torch's threads; default: torch's own")
    parser.add_argument("--device", default="auto", help='of "isaaclab"; default: a GPU if any')
    parser.add_argument("--out", type=Path, help="a JSON file for all figures")
    parser.add_argument("--memory-of", nargs=2, help=argparse.SUPPRESS)
    rivals.add_arguments(parser)


def main(arguments: argparse.Namespace) -> int:
    """Measure, write tables to the terminal and figures to a file."""
    if arguments.what == ["rivals"]:
        return rivals.main(arguments)
    unknown = set(arguments.what) - set(CHOICES)
    if unknown:
        raise BenchmarkError(f"Cannot measure {sorted(unknown)}: choose from {', '.join(CHOICES)}.")
    if arguments.threads is not None:
        th.set_num_threads(arguments.threads)
    if arguments.memory_of:
        print(measure_memory(*arguments.memory_of))
        return 0
    figures: dict[str, Any] = {"machine": machine()}
    for what in arguments.what or DEFAULT:
        figures[what], table = measure(what, arguments.repetitions, arguments.device)
        print(f"{table}\n", flush=True)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        print(f"Wrote {arguments.out}.")
    return 0
