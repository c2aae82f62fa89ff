"""``python -m sb3_policyflow.benchmark COMMAND ...``."""

import argparse
import importlib
import sys

from sb3_policyflow.benchmark.errors import BenchmarkError

COMMANDS = {
    "demo": ("demo", "train PolicyFlow on MultiGoal and show which goals it reaches"),
    "run": ("run", "train and evaluate algorithms, environments and seeds"),
    "table": ("report.table", "sum up what was run"),
    "plot": ("figures.plot", "draw learning curves and comparisons of two algorithms"),
    "multigoal": ("multigoal", "the paper's MultiGoal figure"),
    "pointmaze": ("pointmaze", "the paper's exploration maps"),
    "imitation": ("imitation", "tasks with several goals from demonstrations"),
    "agent": ("agent", "HalfCheetah-v5 from demonstrations of a mediocre agent"),
    "playground": ("playground", "four algorithms on tasks of MuJoCo Playground"),
    "card": ("card", "evaluate a model and write its Hugging Face model card"),
    "speed": ("speed.training", "time PolicyFlow and PPO side by side"),
    "environments": ("speed.environments", "time environments on their own"),
}
"""Each command's module, which has ``add_arguments(parser)`` and ``main(arguments)``, and its help.

The module's docstring describes the command.
"""

INTERNAL = {"train-one": "train_one"}
"""What commands start in processes of their own."""

PROGRAM = "python -m sb3_policyflow.benchmark"


def main(argv: list[str]) -> int:
    """Run a command.

    :param argv: The command and its arguments.
    :return: The exit code.
    """
    lines = "\n".join(f"  {name:12} {text}" for name, (_, text) in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description=f"commands:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    modules = INTERNAL | {name: module for name, (module, _) in COMMANDS.items()}
    parser.add_argument("command", metavar="COMMAND")
    command = parser.parse_args(argv[:1] or ["--help"]).command
    if command not in modules:
        parser.error(f"no command {command!r}: choose from {', '.join(COMMANDS)}")
    module = importlib.import_module(f"sb3_policyflow.benchmark.{modules[command]}")
    command_parser = argparse.ArgumentParser(
        prog=f"{PROGRAM} {command}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(command_parser)
    try:
        code: int = module.main(command_parser.parse_args(argv[1:]))
    except BenchmarkError as error:
        print(error, file=sys.stderr)
        return 2
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
