"""Gymnasium's Pendulum-v1 as a batch of arrays: a step of 1024 takes next to no time."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from sb3_policyflow.envs.vector import final_infos

MAX_TORQUE = 2.0
MAX_SPEED = 8.0
TIME_STEP = 0.05
EPISODE_STEPS = 200

Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class PendulumVectorEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Pendulums with m = l = 1 and g = 10, whose episodes of 200 steps end at different times.

    :param num_envs: Number of environments.
    """

    def __init__(self, num_envs: int) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        high = np.array([1.0, 1.0, MAX_SPEED], dtype=np.float32)
        self.single_observation_space = gym.spaces.Box(-high, high, dtype=np.float32)
        self.single_action_space = gym.spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.angle, self.speed = np.zeros(num_envs), np.zeros(num_envs)
        self._steps = np.zeros(num_envs, dtype=np.int64)

    def reset(self, *, seed: int | None = None, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Start all; at the first step of as many different steps of an episode as there are."""
        super().reset(seed=seed)
        self._start(np.ones(self.num_envs, dtype=bool))
        self._steps = np.arange(self.num_envs) % EPISODE_STEPS
        return self._observations(), {}

    def step(self, actions: np.ndarray) -> Step:
        """Turn all by torques of shape (num_envs, 1)."""
        torque = np.clip(actions[:, 0], -MAX_TORQUE, MAX_TORQUE)
        angle = (self.angle + np.pi) % (2 * np.pi) - np.pi
        rewards = -(angle**2 + 0.1 * self.speed**2 + 0.001 * torque**2)
        speed = self.speed + TIME_STEP * (15 * np.sin(self.angle) + 3 * torque)
        self.speed = np.clip(speed, -MAX_SPEED, MAX_SPEED)
        self.angle = self.angle + TIME_STEP * self.speed
        self._steps += 1
        truncated = self._steps >= EPISODE_STEPS
        infos: dict[str, Any] = {}
        if truncated.any():
            infos = final_infos(self._observations(), truncated)
            self._start(truncated)
        return self._observations(), rewards, np.zeros_like(truncated), truncated, infos

    def _start(self, which: np.ndarray) -> None:
        n = int(which.sum())
        self.angle[which] = self.np_random.uniform(-np.pi, np.pi, n)
        self.speed[which] = self.np_random.uniform(-1, 1, n)
        self._steps[which] = 0

    def _observations(self) -> np.ndarray:
        columns = np.cos(self.angle), np.sin(self.angle), self.speed
        return np.stack(columns, axis=1, dtype=np.float32)
