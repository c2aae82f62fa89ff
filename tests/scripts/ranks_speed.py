"""Measures what a second rank brings on one machine.

python tests/scripts/ranks_speed.py [PPO] [--env ENV] [--batch-size N] [--epochs N]
torchrun --nproc-per-node 2 tests/scripts/ranks_speed.py [--env ENV] [--batch-size N] [--epochs N]

Prints timesteps per second of all ranks together: of the median iteration, and the share of it
that collects. There are two threads and eight environments in all, shared by the ranks.
"""

import argparse
import sys
import time
from itertools import pairwise
from statistics import median

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.distributed.ranks import current

N_THREADS, N_ENVS, N_STEPS, N_ITERATIONS = 2, 8, 256, 30


class Clock(BaseCallback):
    """Notes when rollouts begin and end."""

    def __init__(self) -> None:
        super().__init__()
        self.starts: list[float] = []
        self.ends: list[float] = []

    def _on_rollout_start(self) -> None:
        self.starts.append(time.perf_counter())

    def _on_rollout_end(self) -> None:
        self.ends.append(time.perf_counter())

    def _on_step(self) -> bool:
        return True


def main() -> None:
    """Train for some iterations and print their speed on rank 0."""
    parser = argparse.ArgumentParser()
    parser.add_argument("algorithm", nargs="?", choices=["PolicyFlow", "PPO"], default="PolicyFlow")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--epochs", type=int, default=10)
    arguments = parser.parse_args()
    ranks, algorithm = current(), PPO if arguments.algorithm == "PPO" else PolicyFlow
    th.set_num_threads(N_THREADS // ranks.size)
    kind = SubprocVecEnv if algorithm is PPO else DummyVecEnv
    env = make_vec_env(arguments.env, N_ENVS // ranks.size, seed=ranks.rank, vec_env_cls=kind)
    model = algorithm(
        "MlpPolicy",
        VecNormalize(env),
        n_steps=N_STEPS,
        batch_size=arguments.batch_size,
        n_epochs=arguments.epochs,
        device="cpu",
    )
    clock = Clock()
    model.learn(N_ITERATIONS * N_ENVS * N_STEPS, callback=clock)
    starts, ends = clock.starts[5:], clock.ends[5:]
    iteration = median(b - a for a, b in pairwise(starts))
    rollout = median(b - a for a, b in zip(starts, ends, strict=True))
    if ranks.rank == 0:
        sys.stdout.write(
            f"{N_ENVS * N_STEPS / iteration:.0f} timesteps per second: rollout "
            f"{1e3 * rollout:.0f} of {1e3 * iteration:.0f} ms\n"
        )


if __name__ == "__main__":
    main()
