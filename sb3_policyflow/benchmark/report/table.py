"""Markdown tables of what was run: returns at the end of the trainings, costs, and comparisons."""

import argparse
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from sb3_policyflow.benchmark.measure.evaluation import MODES, STOCHASTIC
from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.report.statistics import (
    MIN_SEEDS,
    Scores,
    interquartile_mean,
    over_seeds,
    score_matrix,
    share_of_pairs,
    stratified_bootstrap,
)
from sb3_policyflow.benchmark.results import (
    DEFAULT_FOLDER,
    Result,
    distinct,
    load_results,
    select,
)

HEADER = (
    "environment",
    "algorithm",
    "seeds",
    *MODES,
    "gradient steps",
    "evaluations acting / updating",
    "minutes",
)

FEW_SEEDS = "mean (minimum to maximum) over seeds"
MANY_SEEDS = "interquartile mean [95 % interval of a bootstrap] over seeds"
BOOTSTRAP = "95 % interval of a bootstrap over seeds, stratified by environment"


def results_table(results: Sequence[Result]) -> str:
    """A row for each environment and name."""
    rows = [
        _row(runs, name, env)
        for env in distinct(results, "env")
        for name in distinct(results, "name")
        if (runs := select(results, name, env))
    ]
    return markdown_table(HEADER, rows)


def _row(results: Sequence[Result], name: str, env: str) -> list[str]:
    evaluations = [result.summary["network_evaluations"] for result in results]
    acting, updating = (np.mean([e[key] for e in evaluations]) for key in ("acting", "updating"))
    minutes = np.mean([result.summary["seconds"]["training"] for result in results]) / 60
    returns = [[result.final_return(mode) for result in results] for mode in MODES]
    found = [[value for value in values if value is not None] for values in returns]
    return [
        f"{env}, {steps_trained(results)} steps",
        name,
        str(len(results)),
        *(over_seeds(values).format() if values else "-" for values in found),
        f"{np.mean([result.summary['gradient_steps'] for result in results]):,.0f}",
        f"{acting / 1e6:,.1f} M / {updating / 1e6:,.1f} M",
        f"{minutes:.1f}",
    ]


def steps_trained(results: Sequence[Result]) -> str:
    """How long trainings were: whole rollouts, which may go beyond what was asked for."""
    steps = {result.summary["timesteps"] for result in results}
    return " / ".join(f"{step:,}" for step in sorted(steps))


def seeds_caption(results: Sequence[Result]) -> str:
    """What the numbers over seeds are, which depends on how many seeds there are."""
    pairs = {(result.run.name, result.run.env) for result in results}
    counts = [len(select(results, *pair)) for pair in pairs]
    few = [FEW_SEEDS] if min(counts) < MIN_SEEDS else []
    many = [MANY_SEEDS] if max(counts) >= MIN_SEEDS else []
    text = f"; from {MIN_SEEDS} seeds on ".join(few + many)
    return f"{text[0].upper()}{text[1:]}."


def overall_table(results: Sequence[Result]) -> str:
    """A row for each name: over all environments together, whose returns must be of one scale.

    Environments count that all names have, and seeds that a name has in all of these.
    """
    names = distinct(results, "name")
    envs = [env for env in distinct(results, "env") if all(select(results, n, env) for n in names)]
    shared = [result for result in results if result.run.env in envs]
    rows = []
    for name in names:
        scores = [
            _common_seeds(list(_scores_by_env(shared, name, mode).values())) for mode in MODES
        ]
        n_seeds = len(scores[0][0]) if scores[0] else 0
        rows.append([name, f"{len(envs)} x {n_seeds}", *map(_overall, scores)])
    table = markdown_table(("algorithm", "environments x seeds", *MODES), rows)
    return f"{table}\n\nInterquartile mean over all runs [{BOOTSTRAP}]."


def _overall(scores: Sequence[Sequence[float]]) -> str:
    if not scores:
        return "-"
    matrix = score_matrix(scores)
    if len(matrix) == 1:  # nothing to resample
        return f"{interquartile_mean(matrix):.4g}"
    return stratified_bootstrap(interquartile_mean, matrix).format()


def comparison_table(results: Sequence[Result], mode: str = STOCHASTIC) -> str:
    """How often one name does better than another, over all environments of both."""
    rows = []
    for name, other in combinations(distinct(results, "name"), 2):
        scores = paired_scores(results, name, other, mode)
        if scores is not None:
            rows.append([name, other, _comparison(*scores)])
    table = markdown_table(["", "better than", "share of pairs"], rows)
    interval = f" [{BOOTSTRAP}]" if any("[" in row[-1] for row in rows) else ""
    return (
        f"{table}\n\nShare of the pairs of runs, one of each algorithm in the same environment, in "
        f"which the first one's return is the greater{interval}."
    )


def _comparison(scores: Scores, others: Scores) -> str:
    if min(len(scores), len(others)) >= MIN_SEEDS:
        return stratified_bootstrap(share_of_pairs, scores, others).format(".2f")
    share = float(share_of_pairs(scores, others))
    n_pairs = len(scores) * others.size
    return f"{share:.2f} ({share * n_pairs:g} of {n_pairs})"


def paired_scores(
    results: Sequence[Result], name: str, other: str, mode: str
) -> tuple[Scores, Scores] | None:
    """Final returns of two names in the environments that both have, (n_seeds, n_environments).

    Of each name the seeds count that it has in all of these; None if there is nothing to compare.
    """
    pair = [_scores_by_env(results, who, mode) for who in (name, other)]
    envs = [env for env in pair[0] if env in pair[1]]
    ours, theirs = (_common_seeds([scores[env] for env in envs]) for scores in pair)
    return (score_matrix(ours), score_matrix(theirs)) if ours and theirs else None


def _scores_by_env(results: Sequence[Result], name: str, mode: str) -> dict[str, dict[int, float]]:
    """Final returns of one name, by environment and seed."""
    scores: dict[str, dict[int, float]] = {}
    for result in results:
        score = result.final_return(mode)
        if result.run.name == name and score is not None:
            scores.setdefault(result.run.env, {})[result.run.seed] = score
    return scores


def _common_seeds(tasks: Sequence[dict[int, float]]) -> list[list[float]]:
    """Scores of the tasks, of those seeds that all of them have; empty if there are none."""
    seeds = sorted(set.intersection(*map(set, tasks))) if tasks else []
    return [[scores[seed] for seed in seeds] for scores in tasks] if seeds else []


def report(results: Sequence[Result], overall: bool = False) -> str:
    """The table, and for more than one name that of the comparisons.

    :param results: What was run.
    :param overall: Whether to begin with the table over all environments together.
    """
    parts = [overall_table(results)] if overall else []
    parts += [results_table(results), seeds_caption(results)]
    if len(distinct(results, "name")) > 1:
        parts.append(comparison_table(results))
    return "\n\n".join(parts) + "\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "folder", type=Path, nargs="?", default=DEFAULT_FOLDER, help="what `run` has written"
    )
    parser.add_argument("--out", type=Path, help="a file; the terminal if not given")
    parser.add_argument(
        "--overall",
        action="store_true",
        help="over all environments together, too; their returns must be of one scale",
    )


def main(arguments: argparse.Namespace) -> int:
    """Write the tables to the terminal or to a file."""
    text = report(load_results(arguments.folder), arguments.overall)
    if arguments.out is None:
        print(text, end="")
    else:
        arguments.out.write_text(text, encoding="utf-8")
        print(f"Wrote {arguments.out}.")
    return 0
