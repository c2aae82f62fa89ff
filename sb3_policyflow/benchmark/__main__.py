"""``python -m sb3_policyflow.benchmark SUBCOMMAND ...``: each is a module with ``main(argv)``."""

import argparse
import importlib
import sys

from sb3_policyflow.benchmark.results import ResultsError

SUBCOMMANDS = {
    "demo": "train PolicyFlow on MultiGoal and show which goals it reaches",
    "run": "train and evaluate algorithms, environments and seeds",
    "table": "sum up what was run",
    "plot": "draw learning curves and probabilities of improvement",
    "multigoal": "the paper's MultiGoal figure",
    "pointmaze": "the paper's exploration maps",
    "playground": "four algorithms on tasks of MuJoCo Playground",
    "speed": "time PolicyFlow and PPO side by side",
    "environments": "time environments on their own",
    "cell": "one training, as `run` starts it",
}
"""What each does; the module is of the same name."""


def main(argv: list[str]) -> int:
    """Hand the arguments to a subcommand's module."""
    lines = "\n".join(f"  {name:12} {text}" for name, text in SUBCOMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.benchmark",
        description=f"subcommands:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("subcommand", choices=SUBCOMMANDS, metavar="SUBCOMMAND")
    name = parser.parse_args(argv[:1] or ["--help"]).subcommand
    module = importlib.import_module(f"sb3_policyflow.benchmark.{name}")
    try:
        code: int = module.main(argv[1:])
    except ResultsError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
