"""Clone a policy from demonstrations and save it.

.. code-block:: bash

    python -m sb3_policyflow.imitation --algo policyflow --env MultiGoal-v0 \
        --dataset minari:multigoal/good-v0 --out model.zip
    python -m rl_zoo3.train --algo policyflow --env MultiGoal-v0 -i model.zip

The hyperparameters are those with which rl_zoo3 trains. Statistics of ``VecNormalize`` go to
``ENV/vecnormalize.pkl`` beside the model, where rl_zoo3 looks for them. If it is interrupted, the
same command continues.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from sb3_policyflow.resilience.files import with_ending


def main(arguments: list[str] | None = None) -> None:
    """Clone from the command line.

    :param arguments: Arguments of the command line; those of the process if not given.
    """
    # Only now: the names that rl_zoo3 knows depend on what has been registered.
    from rl_zoo3.utils import StoreDict

    options = _parser(StoreDict).parse_args(arguments)
    out = with_ending(options.out, ".zip")
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as logs:
        manager = _experiment(options, out, logs)
        model = manager.setup_experiment()[0]
        model.save(out)
        if (normalize := model.get_vec_normalize_env()) is not None:
            folder = out.parent / str(manager.env_name)
            folder.mkdir(exist_ok=True)
            normalize.save(folder / "vecnormalize.pkl")
        model.get_env().close()
    sys.stdout.write(f"Wrote {out}\n")


def _experiment(options: argparse.Namespace, out: Path, logs: str) -> Any:
    """rl_zoo3's experiment, which clones when it is set up."""
    from rl_zoo3.exp_manager import ExperimentManager

    given = dict(options.hyperparams)
    cloning = {"checkpoint": str(out.with_suffix(".cloning")), **given.pop("imitation_kwargs", {})}
    if options.gradient_steps is not None:
        cloning["gradient_steps"] = options.gradient_steps
    return ExperimentManager(
        options,
        options.algo,
        options.env,
        logs,
        eval_freq=-1,
        hyperparams={**given, "demonstrations": options.dataset, "imitation_kwargs": cloning},
        seed=options.seed,
        device=options.device,
        config=options.conf_file,
        verbose=options.verbose,
        show_progress=options.progress,
    )


def _parser(store_dict: type[argparse.Action]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.imitation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--algo", default="policyflow", help="default: policyflow")
    parser.add_argument("--env", required=True, help="id of the environment")
    parser.add_argument("--dataset", required=True, help="minari:DATASET or an .npz file")
    parser.add_argument("--out", required=True, help="the model's zip file")
    parser.add_argument("--gradient-steps", type=int, help="steps of the optimizer, at most")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--device", default="auto", help="default: auto")
    parser.add_argument("--verbose", type=int, default=1, help="default: 1")
    parser.add_argument("--conf-file", help="file of hyperparameters, as in rl_zoo3.train")
    parser.add_argument("-P", "--progress", action="store_true", help="show a progress bar")
    parser.add_argument(
        "-params",
        "--hyperparams",
        nargs="+",
        action=store_dict,
        default={},
        metavar="NAME:VALUE",
        help="what differs from the file of hyperparameters, as in rl_zoo3.train",
    )
    return parser


if __name__ == "__main__":
    main()
