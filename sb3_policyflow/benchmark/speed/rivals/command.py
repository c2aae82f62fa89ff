"""The command: starts all rivals, lets them take turns, and writes figures and table."""

import argparse
import contextlib
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.benchmark.measure.provenance import machine
from sb3_policyflow.benchmark.speed.rivals.process import Iteration, Process, RivalError, cores
from sb3_policyflow.benchmark.speed.rivals.settings import (
    DEFAULT_SETTINGS,
    REFERENCE,
    RIVALS,
    SETTINGS,
)
from sb3_policyflow.benchmark.speed.rivals.summary import WARM_UP, merge, rivals_table, summarize

HELP = """\
"rivals" times whole iterations of SB3's PPO, PolicyFlow, the PPOs of SBX, rlox, skrl and rsl_rl,
and a PPO in one file with torch.compile, each in a process of its own. They take turns, with equal
environments, networks and batches; the first two iterations of each do not count. What is not
installed is left out, and said. One virtual environment can hold all of them:
python -m venv rivals; rivals/bin/pip install . "gymnasium[mujoco]" sbx-rl rlox skrl rsl-rl-lib
and then --python rivals/bin/python. "compiled" needs a C++ compiler. How many cores other programs
keep busy meanwhile is recorded; `nice -n -15` before the command, where it is allowed, keeps the
processes from waiting for them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that only this has."""
    group = parser.add_argument_group("rivals", HELP)
    group.add_argument("--settings", nargs="+", choices=SETTINGS, default=DEFAULT_SETTINGS)
    group.add_argument("--rivals", nargs="+", choices=RIVALS, default=tuple(RIVALS))
    group.add_argument(
        "--python",
        action="append",
        default=[],
        metavar="[RIVAL=]PATH",
        help="interpreter of one rival, or of all that have no other; default: this one",
    )


def main(arguments: argparse.Namespace) -> int:
    """Measure, write the table to the terminal and the figures to a file."""
    pythons = interpreters(arguments.python)
    threads = [arguments.threads] if arguments.threads else sorted({len(cores()), 1}, reverse=True)
    runs = [
        time_rivals(arguments.rivals, setting, n_threads, arguments.repetitions, pythons)
        for setting in arguments.settings
        for n_threads in threads
    ]
    print(rivals_table(runs))
    for run in runs:
        for name, reason in run["left_out"].items():
            print(f"{name} is left out of {run['title']}, threads: {run['threads']}: {reason}")
    if arguments.out is not None:
        merged = {"runs": merge(arguments.out, runs)}
        arguments.out.write_text(json.dumps(merged, indent=1) + "\n", encoding="utf-8")
        print(f"Wrote {arguments.out}.")
    return 0


def interpreters(options: Sequence[str]) -> dict[str, str]:
    """The interpreter of each rival.

    >>> pythons = interpreters(["all/python", "sbx=its/python"])
    >>> pythons["sbx"], pythons["rlox"]
    ('its/python', 'all/python')
    """
    default, own = sys.executable, {}
    for option in options:
        name, _, path = option.partition("=")
        if name in RIVALS:
            own[name] = path
        else:
            default = option
    return dict.fromkeys(RIVALS, default) | own


class Race:
    """Rivals in one setting, of which one after the other trains.

    :param setting: A key of ``SETTINGS``.
    :param threads: Number of threads of each.
    :param pythons: The interpreter of each rival.
    """

    def __init__(self, setting: str, threads: int, pythons: Mapping[str, str]) -> None:
        self.setting, self.threads, self.pythons = setting, threads, pythons
        self.processes: dict[str, Process] = {}
        self.taken: dict[str, list[Iteration]] = {}
        self.left_out: dict[str, str] = {}

    def train(self, name: str, n_iterations: int) -> None:
        """Let a rival train, which is started if it has not been, unless it failed before."""
        if name in self.left_out:
            return
        try:
            if name not in self.processes:
                python = self.pythons[name]
                self.processes[name] = Process(name, self.setting, self.threads, python)
            new = [self.processes[name].iteration() for _ in range(n_iterations)]
        except RivalError as error:
            self.left_out[name] = str(error)
            self.taken.pop(name, None)
        else:
            self.taken.setdefault(name, []).extend(new)

    def close(self) -> None:
        """End all processes."""
        for process in self.processes.values():
            process.close()


def time_rivals(
    names: Sequence[str], setting: str, threads: int, repetitions: int, pythons: Mapping[str, str]
) -> dict[str, Any]:
    """Start the rivals and SB3's PPO, let them take turns, and sum up.

    :param names: The rivals, keys of ``RIVALS``.
    :param repetitions: Iterations of each that count; see ``Race`` for the rest.
    :raises BenchmarkError: If SB3's PPO does not train.
    """
    in_turn = [name for name in RIVALS if name in {REFERENCE, *names}]
    with contextlib.closing(Race(setting, threads, pythons)) as race:
        for n_iterations in (WARM_UP, *[1] * repetitions):
            for name in in_turn:
                race.train(name, n_iterations)
            if REFERENCE in race.left_out:
                raise BenchmarkError(f"SB3's PPO does not train: {race.left_out[REFERENCE]}")
    versions = {name: {"versions": race.processes[name].versions} for name in race.taken}
    figures = summarize(race.taken)
    return {
        "setting": setting,
        "title": SETTINGS[setting].title,
        "threads": threads,
        "machine": machine(),
        "rivals": {name: versions[name] | each for name, each in figures.items()},
        "left_out": race.left_out,
    }
