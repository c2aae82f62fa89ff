"""``python -m sb3_policyflow.export MODEL OUTPUT ...``."""

import argparse
import sys
from pathlib import Path

from sb3_policyflow.export import export, load_model
from sb3_policyflow.resilience.files import saved_model
from sb3_policyflow.resilience.normalization import read_statistics

DESCRIPTION = "Write a policy to a file that runs without this package: ONNX, or torch alone."


def _statistics_beside(model: Path) -> str:
    """Advice that names the statistics that SB3's callbacks and rl_zoo3 keep beside a model."""
    found = sorted({*model.parent.glob("*/vecnormalize.pkl"), *model.parent.glob("*vecnorm*.pkl")})
    return f" There is {found[0]}." if found else ""


def main(arguments: list[str] | None = None) -> None:
    """Export a policy from the command line.

    :param arguments: Arguments of the command line; those of the process if not given.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.export", description=DESCRIPTION
    )
    parser.add_argument("model", type=Path, help="the model's zip file")
    parser.add_argument("output", type=Path, help="the file to write, .onnx or .pt2")
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--vecnormalize", type=Path, metavar="PKL", help="what VecNormalize.save wrote"
    )
    group.add_argument(
        "--normalized-input",
        action="store_true",
        help="let the file take observations that are normalized already",
    )
    parser.add_argument("--latents", action="store_true", help="make the latents an input")
    options = parser.parse_args(arguments)
    path = saved_model(options.model)
    for file in (path, options.vecnormalize):
        if file is not None and not file.is_file():
            sys.exit(f"There is no file {file}.")
    try:
        statistics = options.vecnormalize and read_statistics(options.vecnormalize)
        model = load_model(path)
        export(model, options.output, statistics, options.latents, options.normalized_input)
    except (ValueError, ModuleNotFoundError) as error:
        advice = _statistics_beside(path) if "VecNormalize, without" in str(error) else ""
        sys.exit(f"{error}{advice}")
    sys.stdout.write(f"Wrote {options.output}\n")


if __name__ == "__main__":
    main()
