"""A Markdown table of what was run: interquartile means over seeds with 95 % intervals, and costs.

Intervals are from the percentile bootstrap over seeds; of one seed there is none.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import numpy as np

from sb3_policyflow.benchmark.evaluation import DETERMINISTIC, LATENT_ONLY, STOCHASTIC
from sb3_policyflow.benchmark.results import Result, distinct, load_results, select
from sb3_policyflow.benchmark.run import DEFAULT_FOLDER
from sb3_policyflow.benchmark.statistics import (
    Interval,
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
    score_matrix,
)

MODES = (STOCHASTIC, LATENT_ONLY, DETERMINISTIC)
HEADER = (
    "environment",
    "algorithm",
    "seeds",
    *MODES,
    "gradient steps",
    "evaluations acting / updating",
    "minutes",
)


def results_table(results: Sequence[Result]) -> str:
    """A row for each environment and name."""
    rows = [
        _row(select(results, name, env), name, env)
        for env in distinct(results, "env")
        for name in distinct(results, "name")
        if select(results, name, env)
    ]
    return markdown_table(HEADER, rows)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in GitHub's Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _row(runs: Sequence[Result], name: str, env: str) -> list[str]:
    steps = {run.cell.steps for run in runs}
    evaluations = [run.summary["network_evaluations"] for run in runs]
    acting, updating = (np.mean([e[key] for e in evaluations]) for key in ("acting", "updating"))
    minutes = np.mean([run.summary["seconds"]["training"] for run in runs]) / 60
    return [
        f"{env}, {' / '.join(f'{step:.2g}' for step in sorted(steps))} steps",
        name,
        str(len(runs)),
        *(_returns([run.final_return(mode) for run in runs]) for mode in MODES),
        f"{np.mean([run.summary['gradient_steps'] for run in runs]):,.0f}",
        f"{acting / 1e6:,.1f} M / {updating / 1e6:,.1f} M",
        f"{minutes:.1f}",
    ]


def _returns(returns: Sequence[float | None]) -> str:
    """The interquartile mean with its interval."""
    scores = [value for value in returns if value is not None]
    if not scores:
        return "-"
    return format_interval(bootstrap_interval(interquartile_mean, score_matrix([scores])))


def format_interval(interval: Interval) -> str:
    """Estimate and interval with three digits or more; the estimate alone if there is no other.

    >>> format_interval(Interval(-151.23, -180.0, -140.4))
    '-151.2 [-180, -140.4]'
    """
    if math.isnan(interval.low):
        return f"{interval.estimate:.4g}"
    return f"{interval.estimate:.4g} [{interval.low:.4g}, {interval.high:.4g}]"


def overall_table(results: Sequence[Result]) -> str:
    """A row for each name: over all environments together, whose returns must be of one scale.

    Environments count that all names have, and seeds that a name has in all of these.
    """
    names = distinct(results, "name")
    envs = [env for env in distinct(results, "env") if all(select(results, n, env) for n in names)]
    shared = [run for run in results if run.cell.env in envs]
    rows = []
    for name in names:
        scores = [
            _common_seeds(list(_scores_by_env(shared, name, mode).values())) for mode in MODES
        ]
        n_seeds = len(scores[0][0]) if scores[0] else 0
        rows.append([name, f"{len(envs)} x {n_seeds}", *map(_overall, scores)])
    return markdown_table(("algorithm", "environments x seeds", *MODES), rows)


def _overall(scores: Sequence[Sequence[float]]) -> str:
    if not scores:
        return "-"
    return format_interval(bootstrap_interval(interquartile_mean, score_matrix(scores)))


def improvement_table(results: Sequence[Result], mode: str = STOCHASTIC) -> str:
    """Probabilities that one name does better than another, over all environments of both."""
    rows = []
    for name, other in permutations(distinct(results, "name"), 2):
        interval = improvement(results, name, other, mode)
        if interval is not None:
            rows.append([name, other, format_interval(interval)])
    return markdown_table(["", "better than", "probability"], rows)


def improvement(results: Sequence[Result], name: str, other: str, mode: str) -> Interval | None:
    """Probability that one name does better than another, over the environments that both have.

    Of each name the seeds count that it has in all of these; None if there is nothing to compare.
    """
    pair = [_scores_by_env(results, who, mode) for who in (name, other)]
    envs = [env for env in pair[0] if env in pair[1]]
    matrices = [_common_seeds([scores[env] for env in envs]) for scores in pair]
    if not all(matrices):
        return None
    return bootstrap_interval(probability_of_improvement, *map(score_matrix, matrices))


def _scores_by_env(results: Sequence[Result], name: str, mode: str) -> dict[str, dict[int, float]]:
    """Final returns of one name, by environment and seed."""
    scores: dict[str, dict[int, float]] = {}
    for run in results:
        score = run.final_return(mode)
        if run.cell.name == name and score is not None:
            scores.setdefault(run.cell.env, {})[run.cell.seed] = score
    return scores


def _common_seeds(tasks: Sequence[dict[int, float]]) -> list[list[float]]:
    """Scores of the tasks, of those seeds that all of them have; empty if there are none."""
    seeds = sorted(set.intersection(*map(set, tasks))) if tasks else []
    return [[scores[seed] for seed in seeds] for scores in tasks] if seeds else []


def summary(results: Sequence[Result]) -> str:
    """The table and, for more than one name, that of the improvements."""
    parts = [results_table(results)]
    if len(distinct(results, "name")) > 1:
        parts.append(improvement_table(results))
    return "\n\n".join(parts) + "\n"


def main(argv: list[str]) -> int:
    """Write the tables to the terminal or to a file."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.benchmark table", description=__doc__
    )
    parser.add_argument("folder", type=Path, nargs="?", default=DEFAULT_FOLDER)
    parser.add_argument("--out", type=Path, help="a file; the terminal if not given")
    arguments = parser.parse_args(argv)
    text = summary(load_results(arguments.folder))
    if arguments.out is None:
        sys.stdout.write(text)
    else:
        arguments.out.write_text(text, encoding="utf-8")
    return 0
