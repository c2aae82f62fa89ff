"""Make demonstrations of this package's tasks.

.. code-block:: bash

    python -m sb3_policyflow.imitation.demonstrate --env MultiGoal-v0 --style slow \
        --out minari:multigoal/slow-v0
"""

import argparse
import sys

import numpy as np

from sb3_policyflow.imitation.demonstrators import STYLES, demonstrate, make_env
from sb3_policyflow.imitation.episodes import save_episodes


def main(arguments: list[str] | None = None) -> None:
    """Make demonstrations from the command line.

    :param arguments: Arguments of the command line; those of the process if not given.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.imitation.demonstrate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    styles = sorted({style for own in STYLES.values() for style in own})
    parser.add_argument("--env", required=True, choices=STYLES, help="the task")
    parser.add_argument("--style", default="good", choices=styles, help="default: good")
    parser.add_argument("--episodes", type=int, help="default: enough for the task's modes")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--out", required=True, help="minari:DATASET or a file .npz")
    options = parser.parse_args(arguments)
    episodes = demonstrate(options.env, options.style, options.episodes, options.seed)
    save_episodes(episodes, options.out, make_env(options.env, 1, options.seed), options.env)
    returns = [episode.rews.sum() for episode in episodes]
    sys.stdout.write(
        f"Wrote {len(episodes)} episodes with a mean return of {np.mean(returns):.2f} to "
        f"{options.out}\n"
    )


if __name__ == "__main__":
    main()
