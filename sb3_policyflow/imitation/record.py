"""Record what a trained model does, as demonstrations.

.. code-block:: bash

    python -m sb3_policyflow.imitation.record --algo ppo --env Pendulum-v1 -f logs \
        --out minari:pendulum/ppo-v0

The model is found and loaded as ``rl_zoo3.enjoy`` does it.
"""

import argparse
import os
import sys
from typing import Any

import numpy as np
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_policyflow.envs import ensure_registered
from sb3_policyflow.imitation.episodes import record_episodes, save_episodes


def main(arguments: list[str] | None = None) -> None:
    """Record from the command line.

    :param arguments: Arguments of the command line; those of the process if not given.
    """
    options = _parser().parse_args(arguments)
    model, env = _load(options)
    episodes = record_episodes(model, env, options.episodes, options.deterministic)
    save_episodes(episodes, options.out, env, options.env)
    returns = [episode.rews.sum() for episode in episodes]
    sys.stdout.write(
        f"Wrote {len(episodes)} episodes with a mean return of {np.mean(returns):.2f} to "
        f"{options.out}\n"
    )


def _load(options: argparse.Namespace) -> tuple[Any, VecEnv]:
    """The model of a run of rl_zoo3, and the environment that it was trained in."""
    # Only now: the names that rl_zoo3 knows depend on what has been registered.
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import ALGOS, create_test_env, get_model_path, get_saved_hyperparams

    ensure_registered(options.env)
    name = EnvironmentName(options.env)
    _, model_path, log_path = get_model_path(
        options.exp_id, options.folder, options.algo, name, options.load_best
    )
    hyperparams, stats_path = get_saved_hyperparams(os.path.join(log_path, name), test_mode=True)
    set_random_seed(options.seed)
    env = create_test_env(
        options.env,
        n_envs=options.n_envs,
        stats_path=stats_path,
        seed=options.seed,
        log_dir=None,
        should_render=False,
        env_kwargs=hyperparams.pop("env_kwargs", None),
        hyperparams=hyperparams,
        vec_env_cls=DummyVecEnv,
    )
    return ALGOS[options.algo].load(model_path, device="cpu"), env


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.imitation.record",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--algo", required=True, help="rl_zoo3's name of the algorithm")
    parser.add_argument("--env", required=True, help="id of the environment")
    parser.add_argument("-f", "--folder", default="logs", help="rl_zoo3's logs; default: logs")
    parser.add_argument(
        "--exp-id", type=int, default=0, help="number of the run; default: the last"
    )
    parser.add_argument("--load-best", action="store_true", help="take best_model.zip")
    parser.add_argument("--episodes", type=int, default=100, help="default: 100")
    parser.add_argument("--n-envs", type=int, default=8, help="environments at a time; default: 8")
    parser.add_argument("--deterministic", action="store_true", help="draw nothing at random")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--out", required=True, help="minari:DATASET or a file .npz")
    return parser


if __name__ == "__main__":
    main()
