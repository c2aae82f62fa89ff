"""What demonstrations of a mediocre agent are worth: the steps to twice their return.

Trains PolicyFlow on HalfCheetah-v5 for a while and records what it does. Then trains PolicyFlow
with every seed, from a clone of that agent and from scratch, and writes the table to ``agent.md``.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_policyflow.benchmark.errors import BenchmarkError, at_least, require_env
from sb3_policyflow.benchmark.experiment import make_experiment
from sb3_policyflow.benchmark.measure.evaluation import STOCHASTIC
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.report.statistics import over_seeds
from sb3_policyflow.benchmark.report.table import seeds_caption, steps_trained
from sb3_policyflow.benchmark.results import Result, Run, distinct, load_results
from sb3_policyflow.benchmark.run import add_running_arguments, run_and_report
from sb3_policyflow.imitation.episodes import record_episodes, save_episodes

ENV = "HalfCheetah-v5"
ALGO = "policyflow"
AGENT_SEED = 100
"""Of the agent that demonstrates; no training has it."""
AGENT_STEPS = 50_000
N_DEMONSTRATIONS = 100
VARIANTS: dict[str, dict[str, Any]] = {
    "cloned": {"n_critic_warmup": 10, "imitation_kwargs": {"noise_std": 0.3}},
    "scratch": {},
}
"""What differs from the YAML file. The agent's own noise has not fallen far when it stops."""
HEADER = ("start", "seeds", "steps", "return at the first evaluation", "return at the end")


def demonstrations(folder: Path) -> Path:
    """The file of the agent's episodes."""
    return folder / "demonstrations" / f"{ENV}.npz"


def make_demonstrations(path: Path, steps: int = AGENT_STEPS, n: int = N_DEMONSTRATIONS) -> None:
    """Train an agent and record it, unless the file is there.

    :param path: The file.
    :param steps: Environment steps of the agent's training.
    :param n: Episodes.
    """
    if path.is_file() and _report(path).is_file():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as logs:
        model: Any = make_experiment(ALGO, ENV, steps, AGENT_SEED, logs).model
        model.learn(steps)
        episodes = record_episodes(model, n_episodes=n)
        said = {
            "agent_steps": model.num_timesteps,
            "episodes": len(episodes),
            "mean_return": float(np.mean([episode.rews.sum() for episode in episodes])),
        }
        _report(path).write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")
        save_episodes(episodes, path, model.get_env())
        model.get_env().close()


def wanted_return(path: Path) -> float:
    """Twice the mean sum of rewards of the agent's episodes.

    :raises BenchmarkError: If that is not more.
    """
    mean = float(json.loads(_report(path).read_text(encoding="utf-8"))["mean_return"])
    if mean <= 0:
        raise BenchmarkError(
            f"{_report(path)} has a mean return of {mean:.0f}, twice which is no more: delete it, "
            "and train the agent for longer (AGENT_STEPS)."
        )
    return 2 * mean


def _report(path: Path) -> Path:
    """Where it is said what the agent did: beside the folder of what is not kept."""
    return path.parents[1] / "agent.json"


def runs(arguments: argparse.Namespace) -> list[Run]:
    """The trainings that are wanted, seed after seed."""
    path = str(demonstrations(arguments.out))
    return [
        Run(
            name,
            ALGO,
            ENV,
            seed,
            int(arguments.steps),
            {**VARIANTS[name], **({"demonstrations": path} if name == "cloned" else {})},
            n_evaluations=arguments.evaluations,
            n_episodes=arguments.episodes,
        )
        for seed in arguments.seeds
        for name in VARIANTS
    ]


def steps_to(result: Result, wanted: float) -> int | None:
    """Timesteps of the first evaluation with this return, actions drawn; None if there is none.

    :param result: What came of a training.
    :param wanted: The return.
    """
    curve = [row for row in result.curve if row["mode"] == STOCHASTIC]
    reached = [int(row["timesteps"]) for row in curve if row["mean_return"] >= wanted]
    return min(reached, default=None)


def agent_table(results: Sequence[Result], wanted: float) -> str:
    """A row for each start.

    :param results: What was run.
    :param wanted: Twice the demonstrations' return.
    """
    rows = []
    for name in distinct(results, "name"):
        own = [result for result in results if result.run.name == name]
        curves = [[r for r in result.curve if r["mode"] == STOCHASTIC] for result in own]
        returns = [
            over_seeds([float(curve[index]["mean_return"]) for curve in curves]).format(".0f")
            for index in (0, -1)
        ]
        reached = [steps for result in own if (steps := steps_to(result, wanted)) is not None]
        said = over_seeds(reached).format(",.0f") if reached else "never"
        if 0 < len(reached) < len(own):
            said += f" ({len(reached)} of {len(own)} seeds)"
        rows.append([name, str(len(own)), steps_trained(own), *returns, said])
    header = (*HEADER, f"steps to a return of {wanted:.0f}")
    return f"{markdown_table(header, rows)}\n\n{seeds_caption(results)}\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--steps",
        type=at_least(1, float),
        default=3e5,
        help="environment steps of each; default: 3e5",
    )
    add_running_arguments(parser, Path("docs/results/agent"))
    parser.set_defaults(episodes=5, evaluations=30)


def main(arguments: argparse.Namespace) -> int:
    """Make the demonstrations, train what is missing and write the table."""
    require_env(ENV)
    th.set_num_threads(arguments.threads)
    path = demonstrations(arguments.out)
    make_demonstrations(path)
    wanted = wanted_return(path)
    code = run_and_report(runs(arguments), arguments)
    table = agent_table(load_results(arguments.out), wanted)
    (arguments.out / "agent.md").write_text(table, encoding="utf-8")
    print(f"Wrote {arguments.out / 'agent.md'}.")
    return code
