"""The launcher of version 3."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class AppLauncher:
    """There still is one, and it is not to be used."""


def add_launcher_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--headless", action="store_true")
    parser.add_argument("--device", default=None)


@contextmanager
def launch_simulation(cfg: Any, launcher_args: Any = None) -> Iterator[None]:
    assert hasattr(cfg, "compute_final_obs")
    yield
    print("simulation closed")  # noqa: T201
