"""What a step of a rollout costs besides environment and policy, as arrays and as tensors.

python tests/scripts/collection_overhead.py [ENVIRONMENTS]

The environment and the policy return what they have at hand. SB3's PPO collects from arrays, and
from the list of a dictionary for each environment that SB3 asks for; PolicyFlow from tensors. Four
episodes end in each step. Observations and actions have the sizes of MultiGoal and of Anymal-D.
"""

import sys
import time
from collections import deque
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import PPO

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.tensor import TensorEnvAdapter, TensorStep

N_STEPS, N_ENDED = 24, 4
DIMENSIONS = {"MultiGoal": (4, 2), "Anymal-D": (48, 12)}


class Idle:
    """Returns the same tensors in each step."""

    device = th.device("cpu")

    def __init__(self, num_envs: int, obs_dim: int, action_dim: int) -> None:
        self.num_envs = num_envs
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (action_dim,), np.float32)
        self.observations = th.zeros(num_envs, obs_dim)
        terminated = th.zeros(num_envs, dtype=th.bool)
        terminated[:N_ENDED] = True
        ended = terminated.nonzero().flatten()
        self.returned = TensorStep(
            self.observations,
            th.zeros(num_envs),
            terminated,
            th.zeros(num_envs, dtype=th.bool),
            ended,
            self.observations[ended],
        )

    def reset(self) -> th.Tensor:
        return self.observations

    def step(self, actions: th.Tensor) -> TensorStep:
        return self.returned


class IdleArrays(TensorEnvAdapter):
    """Returns the same arrays in each step, and a new list of infos."""

    def __init__(self, env: Idle) -> None:
        super().__init__(env)
        super().step_async(np.zeros((env.num_envs, *env.action_space.shape), np.float32))
        *self.arrays, self.infos = super().step_wait()

    def step_async(self, actions: np.ndarray) -> None:
        pass

    def step_wait(self) -> Any:
        return *self.arrays, [{**info} for info in self.infos]


def microseconds_per_step(model: Any) -> float:
    """The median of several rollouts."""
    policy, n_envs = model.policy, model.n_envs
    with th.no_grad():
        made = policy(th.zeros(n_envs, *model.observation_space.shape))
    policy.forward = lambda obs: made
    policy.predict_values = lambda obs: made[1]
    model.ep_info_buffer, model.ep_success_buffer = deque(maxlen=100), deque(maxlen=100)
    _, callback = model._setup_learn(N_STEPS * n_envs)
    times = []
    for _ in range(12):
        began = time.perf_counter()
        model.collect_rollouts(model.env, callback, model.rollout_buffer, N_STEPS)
        times.append(1e6 * (time.perf_counter() - began) / N_STEPS)
    return median(times[2:])


def main(n_envs: int) -> None:
    """Print both, and the ratio."""
    th.set_num_threads(1)
    options = {"n_steps": N_STEPS, "batch_size": N_STEPS * n_envs, "device": "cpu"}
    for name, dimensions in DIMENSIONS.items():
        idle = Idle(n_envs, *dimensions)
        arrays = microseconds_per_step(PPO("MlpPolicy", IdleArrays(idle), **options))
        tensors = microseconds_per_step(PolicyFlow("MlpPolicy", idle, **options))
        sys.stdout.write(
            f"{n_envs} environments of {name}: SB3 {arrays:.0f} us a step, tensors "
            f"{tensors:.0f} us, {tensors / arrays:.3f} of it\n"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4096)
