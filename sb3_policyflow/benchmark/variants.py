"""Variants of algorithms that a figure compares, in one environment and with the same steps."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sb3_policyflow.benchmark.errors import at_least
from sb3_policyflow.benchmark.results import Run
from sb3_policyflow.benchmark.run import add_running_arguments


class Variant(NamedTuple):
    """Its title, rl_zoo3's name of the algorithm, and what differs from its YAML file."""

    title: str
    algo: str
    hyperparams: dict[str, Any]


Variants = Mapping[str, Variant]
"""Variants by the name of their results' folder."""


def variant_runs(variants: Variants, arguments: argparse.Namespace, **fields: Any) -> list[Run]:
    """The trainings that a figure needs, seed after seed.

    :param variants: The variants of the figure.
    :param arguments: The options of :func:`add_variant_arguments`.
    :param fields: More fields of the runs, among them ``env``.
    """
    return [
        Run(
            name=name,
            algo=variants[name].algo,
            seed=seed,
            steps=int(arguments.steps),
            hyperparams=variants[name].hyperparams,
            n_evaluations=arguments.evaluations,
            n_episodes=arguments.episodes,
            **fields,
        )
        for seed in arguments.seeds
        for name in arguments.variants
    ]


def add_variant_arguments(
    parser: argparse.ArgumentParser, variants: Variants, steps: float, out: Path
) -> None:
    """Add the options that every figure of variants has.

    :param parser: The command's.
    :param variants: The variants of the figure.
    :param steps: Environment steps of each training, if not given.
    :param out: Folder of the results, if not given.
    """
    parser.add_argument(
        "--steps",
        type=at_least(1, float),
        default=steps,
        help=f"environment steps of each; default: {steps:g}",
    )
    parser.add_argument(
        "--variants", nargs="+", choices=variants, default=list(variants), help="default: all"
    )
    # What version 0.1.0 called them.
    hidden: Any = {"default": argparse.SUPPRESS, "help": argparse.SUPPRESS}
    parser.add_argument("--panels", nargs="+", choices=variants, dest="variants", **hidden)
    add_running_arguments(parser, out)
