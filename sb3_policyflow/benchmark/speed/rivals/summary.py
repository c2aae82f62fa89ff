"""What iterations sum up to: medians, ratios, and the table."""

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sb3_policyflow.benchmark.report.markdown import markdown_table
from sb3_policyflow.benchmark.speed.rivals.process import Iteration
from sb3_policyflow.benchmark.speed.rivals.settings import REFERENCE, RIVALS

WARM_UP = 2
"""Iterations that do not count: the first compiles, the second may again."""


def summarize(taken: Mapping[str, Sequence[Iteration]]) -> dict[str, dict[str, Any]]:
    """Medians, ratios to SB3's PPO, and all iterations of each rival; the first two do not count.

    :param taken: The iterations of each rival, SB3's PPO among them.
    """
    found = {name: _medians(iterations) for name, iterations in taken.items()}
    reference = found[REFERENCE]["seconds"]
    return {name: {"ratio": each["seconds"] / reference, **each} for name, each in found.items()}


def _medians(iterations: Sequence[Iteration]) -> dict[str, Any]:
    counted = iterations[WARM_UP:]
    return {
        "seconds": statistics.median(one.seconds for one in counted),
        "cpu_seconds": statistics.median(one.cpu_seconds for one in counted),
        "first_seconds": iterations[0].seconds,
        "iterations": [asdict(one) for one in counted],
    }


def merge(path: Path, runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The runs of a file, of which the new ones replace those of their setting and threads."""
    old = json.loads(path.read_text(encoding="utf-8"))["runs"] if path.is_file() else []
    merged = {(run["setting"], run["threads"]): run for run in (*old, *runs)}
    return list(merged.values())


def rivals_table(runs: Sequence[dict[str, Any]]) -> str:
    """A row for each rival, a column for each run: milliseconds, and the ratio to SB3's PPO."""
    header = ["", "version", *(f"{run['title']}, threads: {run['threads']}" for run in runs)]
    rows = []
    for name, rival in RIVALS.items():
        entries = [run["rivals"].get(name) for run in runs]
        versions = [entry["versions"]["rival"] for entry in entries if entry]
        if versions:
            rows.append([rival.title, versions[0], *map(_cell, entries)])
    return markdown_table(header, rows)


def _cell(entry: dict[str, Any] | None) -> str:
    if entry is None:
        return "left out"
    return f"{1000 * entry['seconds']:,.0f} ms, **{entry['ratio']:.2f}**"
