"""The launcher of version 2."""

import argparse
import sys


class Simulation:
    def close(self) -> None:
        print("simulation closed")  # noqa: T201


class AppLauncher:
    def __init__(self, options: argparse.Namespace) -> None:
        assert "isaaclab_tasks" not in sys.modules, "tasks need a simulator"
        self.app = Simulation()

    @staticmethod
    def add_app_launcher_args(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--headless", action="store_true")
        parser.add_argument("--device", default="cpu")
