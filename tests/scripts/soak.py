"""Trains for long and watches memory, file handles and speed.

python tests/scripts/soak.py [MINUTES] [FOLDER]

Ends after 50 million steps, or when the time (120 minutes) is over. Prints a line every 2.5 million
steps, and in the end how memory grew (a straight line through the second half), how many file
handles there are, and the speed of both halves.
"""

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.callbacks import FlowDiagnosticsCallback
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback

N_ENVS, N_STEPS = 256, 24
TOTAL_TIMESTEPS = 50_000_000


class Sample(NamedTuple):
    """One look at the process: seconds, timesteps, resident bytes, open files."""

    seconds: float
    timesteps: int
    memory: int
    handles: int


class Watch(BaseCallback):
    """Looks at the process after each update, and ends training when the time is over."""

    def __init__(self, minutes: float) -> None:
        super().__init__()
        self.seconds = 60 * minutes
        self.samples: list[Sample] = []
        self.start = time.perf_counter()
        self.due = 0

    def _on_step(self) -> bool:
        return time.perf_counter() - self.start < self.seconds

    def _on_rollout_start(self) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.samples.append(
            Sample(
                time.perf_counter() - self.start,
                self.num_timesteps,
                pages * os.sysconf("SC_PAGE_SIZE"),
                len(os.listdir("/proc/self/fd")),
            )
        )
        if self.num_timesteps >= self.due:
            self.due += TOTAL_TIMESTEPS // 20
            say(self.samples[-1])


def say(sample: Sample) -> None:
    sys.stdout.write(
        f"{sample.seconds:8.0f} s {sample.timesteps:12d} steps {sample.memory / 2**20:8.1f} MiB "
        f"{sample.handles:4d} handles\n"
    )
    sys.stdout.flush()


def speed(samples: list[Sample]) -> float:
    """Timesteps a second between the first and the last sample."""
    first, last = samples[0], samples[-1]
    return (last.timesteps - first.timesteps) / (last.seconds - first.seconds)


def slope(samples: list[Sample], unit: str, size: float) -> float:
    """Growth of memory in MiB for each ``size`` of a unit of time, by a straight line."""
    memory = [sample.memory / 2**20 for sample in samples]
    times = [getattr(sample, unit) / size for sample in samples]
    return float(np.polyfit(times, memory, 1)[0])


def summary(samples: list[Sample]) -> str:
    """Growth of memory, handles, and the speed of both halves."""
    half = len(samples) // 2
    early, late = samples[:half], samples[half:]
    return (
        f"{samples[-1].timesteps} steps in {samples[-1].seconds / 60:.0f} minutes: memory "
        f"{samples[0].memory / 2**20:.1f} MiB at the start, {late[0].memory / 2**20:.1f} half-way "
        f"and {late[-1].memory / 2**20:.1f} at the end, slope of the second half "
        f"{slope(late, 'seconds', 3600):+.2f} MiB/h, {slope(late, 'timesteps', 1e6):+.3f} MiB per "
        f"million steps; handles {late[0].handles} to {late[-1].handles}; {speed(early):.0f} and "
        f"then {speed(late):.0f} steps/s"
    )


def main(minutes: float, folder: str) -> None:
    """Train with everything on that could leak: logs, checkpoints, diagnostics."""
    th.set_num_threads(1)
    env = VecNormalize(VecMonitor(MultiGoalVecEnv(N_ENVS, seed=0)))
    model = PolicyFlow(
        "MlpPolicy",
        env,
        n_steps=N_STEPS,
        batch_size=1536,
        n_epochs=2,
        desired_kl=0.01,
        brownian_coef=0.25,
        seed=0,
    )
    model.set_logger(configure(folder, ["csv", "json", "tensorboard"]))
    watch = Watch(minutes)
    checkpoint = RolloutCheckpointCallback(20 * N_STEPS, folder, save_vecnormalize=True)
    diagnostics = FlowDiagnosticsCallback(every=10, n_samples=256)
    model.learn(TOTAL_TIMESTEPS, [watch, checkpoint, diagnostics])
    sys.stdout.write(summary(watch.samples) + "\n")


if __name__ == "__main__":
    time_limit = float(sys.argv[1]) if len(sys.argv) > 1 else 120.0
    if len(sys.argv) > 2:
        main(time_limit, sys.argv[2])
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(time_limit, temporary)
