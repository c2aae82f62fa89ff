"""The panels of a figure: variants of algorithms in one environment, with the same steps."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_policyflow.benchmark.results import Cell
from sb3_policyflow.benchmark.run import add_running_arguments


class Panel(NamedTuple):
    """One panel: its title, rl_zoo3's name of the algorithm, and what differs from its YAML."""

    title: str
    algo: str
    hyperparams: dict[str, Any]


Panels = Mapping[str, Panel]
"""Panels by the name of their results' folder."""


def panel_cells(panels: Panels, arguments: argparse.Namespace, **fields: Any) -> list[Cell]:
    """The trainings that a figure needs, seed after seed.

    :param panels: The panels of the figure.
    :param arguments: What :func:`panel_parser` has parsed.
    :param fields: More fields of the cells, among them ``env``.
    """
    return [
        Cell(
            name=name,
            algo=panels[name].algo,
            seed=seed,
            steps=int(arguments.steps),
            hyperparams=panels[name].hyperparams,
            n_evaluations=arguments.evaluations,
            n_episodes=arguments.episodes,
            **fields,
        )
        for seed in arguments.seeds
        for name in arguments.panels
    ]


def panel_parser(
    subcommand: str, description: str | None, panels: Panels, steps: float
) -> argparse.ArgumentParser:
    """A parser with the arguments of every figure of panels.

    :param subcommand: Its name, which is that of the folder in ``docs/results`` too.
    :param description: What it does.
    :param panels: The panels of the figure.
    :param steps: Environment steps of each training, if not given.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m sb3_policyflow.benchmark {subcommand}", description=description
    )
    parser.add_argument(
        "--steps", type=float, default=steps, help=f"environment steps of each; default: {steps:g}"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/results") / subcommand)
    parser.add_argument(
        "--panels", nargs="+", choices=panels, default=list(panels), help="default: all"
    )
    add_running_arguments(parser)
    return parser


def over_seeds(values: Sequence[float], digits: int = 2) -> str:
    """A mean, and the range where there are several values.

    >>> over_seeds([1.0, 2.5])
    '1.75 (1 to 2.5)'
    """
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.3g} to {max(values):.3g})"
