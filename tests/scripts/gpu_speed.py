"""Times MultiGoal on a GPU, through arrays and with tensors, beside SB3's PPO and a CPU.

python tests/scripts/gpu_speed.py [N_ENVS]

Medians of four iterations of 24 steps (two on the CPU), 5 epochs of 4 minibatches, hidden layers
[256, 128, 64], ELU.
"""

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch import nn

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalTensorEnv, MultiGoalVecEnv

N_STEPS = 24


def seconds(work: Callable[[], object]) -> float:
    """How long some work takes, with what it leaves to the GPU."""
    th.cuda.synchronize()
    start = time.perf_counter()
    work()
    th.cuda.synchronize()
    return time.perf_counter() - start


def measure(name: str, model: Any, repetitions: int = 4) -> None:
    """Print medians of an iteration and of its update; the first iteration does not count."""
    timesteps, updates, train = N_STEPS * model.n_envs, [], model.train
    model.learn(timesteps)
    model.train = lambda: updates.append(seconds(train))
    iterations = [
        seconds(lambda: model.learn(timesteps, reset_num_timesteps=False))
        for _ in range(repetitions)
    ]
    iteration, update = statistics.median(iterations), statistics.median(updates)
    sys.stdout.write(
        f"{name}: iteration {1e3 * iteration:.0f} ms, update {1e3 * update:.0f} ms, "
        f"{timesteps / iteration:.0f} steps/s\n"
    )
    sys.stdout.flush()


def main(n_envs: int) -> None:
    """Time all of them."""
    options: dict[str, Any] = {
        "n_steps": N_STEPS,
        "batch_size": N_STEPS * n_envs // 4,
        "n_epochs": 5,
        "seed": 0,
    }
    networks = {"net_arch": [256, 128, 64], "activation_fn": nn.ELU}

    def arrays() -> VecEnv:
        return VecMonitor(MultiGoalVecEnv(n_envs, seed=0))

    def tensors(device: str) -> Any:
        return MultiGoalTensorEnv(n_envs, seed=0, device=device)

    cuda = {**options, "policy_kwargs": networks, "device": "cuda"}
    sys.stdout.write(f"{th.cuda.get_device_name()}, torch {th.__version__}\n")
    measure("PPO, arrays", PPO("MlpPolicy", arrays(), **cuda))
    measure("PolicyFlow, arrays", PolicyFlow("MlpPolicy", arrays(), **cuda))
    for size in (64, 256, 512):
        policy_kwargs = {**networks, "embedding_dim": size}
        model = PolicyFlow("MlpPolicy", tensors("cuda"), **{**cuda, "policy_kwargs": policy_kwargs})
        measure(f"PolicyFlow, tensors, embedding {size}", model)
    cpu = {**cuda, "device": "cpu"}
    measure("PPO, arrays, CPU", PPO("MlpPolicy", arrays(), **cpu), 2)
    measure("PolicyFlow, tensors, CPU", PolicyFlow("MlpPolicy", tensors("cpu"), **cpu), 2)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4096)
