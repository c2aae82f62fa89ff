"""MultiGoal in torch: the physics of ``point_masses``, on any device."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.utils import seeding

from sb3_policyflow.envs.multigoal.point_masses import (
    DT,
    GOALS,
    MAX_ACTION,
    MAX_EPISODE_STEPS,
    START_HALF_WIDTH,
    SUCCESS_RADIUS,
    WALL,
)
from sb3_policyflow.envs.tensor import TensorStep


class MultiGoalTensorEnv:
    """``MultiGoal-v0``, ``num_envs`` environments as tensors: a ``TensorVecEnv``.

    The first states come from NumPy's generator, so that the episodes of a seed are those of
    :class:`~sb3_policyflow.envs.multigoal.MultiGoalVecEnv`.

    :param num_envs: Number of environments.
    :param seed: Seed of the first ``reset``; ``seed()`` sets another.
    :param device: Where the tensors are.
    :param max_episode_steps: Steps after which an episode is truncated.
    """

    def __init__(
        self,
        num_envs: int,
        seed: int | None = None,
        device: th.device | str = "cpu",
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        self.num_envs = num_envs
        self.device = th.device(device)
        self.max_episode_steps = max_episode_steps
        self.observation_space: gym.Space[Any] = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space: gym.Space[Any] = gym.spaces.Box(
            -MAX_ACTION, MAX_ACTION, (2,), np.float32
        )
        self._generator, _ = seeding.np_random(seed)
        self._goals = th.as_tensor(GOALS, device=self.device)
        self._states = th.zeros(num_envs, 4, dtype=th.float64, device=self.device)
        self._steps = th.zeros(num_envs, dtype=th.int64, device=self.device)

    def seed(self, seed: int) -> None:
        """Seed the generator of first states."""
        self._generator, _ = seeding.np_random(seed)

    def reset(self) -> th.Tensor:
        self._start(th.arange(self.num_envs, device=self.device))
        return self._states.float()

    def step(self, actions: th.Tensor) -> TensorStep:
        actions = actions.double()
        positions, velocities = self._states[:, :2], self._states[:, 2:]
        positions += velocities * DT
        velocities += actions.clamp(-MAX_ACTION, MAX_ACTION) * DT
        self._steps += 1
        nearest = (positions @ self._goals.T).argmax(dim=1)
        squared = (positions - self._goals[nearest]).square().sum(dim=1)
        closeness = th.exp(-0.3 * squared) + th.exp(-0.1 * squared)
        rewards = DT * (closeness - 0.01 * actions.square().sum(dim=1))
        terminated = positions.abs().amax(dim=1) > WALL
        truncated = self._steps >= self.max_episode_steps
        ended = (terminated | truncated).nonzero().flatten()
        finals, successes = self._states[ended].float(), squared[ended] <= SUCCESS_RADIUS**2
        self._start(ended)
        observations = self._states.float()
        return TensorStep(
            observations, rewards.float(), terminated, truncated, ended, finals, successes
        )

    def _start(self, which: th.Tensor) -> None:
        """Put points at rest at random positions."""
        if len(which) == 0:
            return
        positions = self._generator.uniform(-START_HALF_WIDTH, START_HALF_WIDTH, (len(which), 2))
        self._states[which, :2] = th.as_tensor(positions, device=self.device)
        self._states[which, 2:] = 0.0
        self._steps[which] = 0
