"""A task of MuJoCo Playground whose steps stay on its device."""

from typing import Any

import gymnasium as gym
import torch as th

from sb3_policyflow.envs.tensor import TensorObs, TensorStep, map_observations


class PlaygroundTensorEnv:
    """A batch of a task as a ``TensorVecEnv``: what JAX computes is shared with torch.

    ``PlaygroundTensorEnv(PlaygroundVectorEnv("CheetahRun", 4096))`` trains on the device on which
    JAX has the task, a GPU where there is one.

    :param env: A :class:`~sb3_policyflow.envs.playground.PlaygroundVectorEnv`.
    """

    def __init__(self, env: Any) -> None:
        self.env = env
        self.num_envs: int = env.num_envs
        self.observation_space: gym.Space[Any] = env.single_observation_space
        self.action_space: gym.Space[Any] = env.single_action_space
        self._seed: int | None = None
        first = env.reset_tensors()
        values = next(iter(first.values())) if isinstance(first, dict) else first
        self.device: th.device = values.device

    def seed(self, seed: int) -> None:
        """Seed the next ``reset``."""
        self._seed = seed

    def reset(self) -> TensorObs:
        seed, self._seed = self._seed, None
        return self.env.reset_tensors(seed)

    def step(self, actions: th.Tensor) -> TensorStep:
        step = self.env.step_tensors(actions)
        # Both flags are on the CPU, where JAX's host needs them.
        ended = (step.terminated | step.truncated).nonzero().flatten().to(self.device)
        finals = map_observations(lambda values: values[ended], step.final_observations)
        return TensorStep(
            step.observations,
            step.rewards,
            step.terminated.to(self.device),
            step.truncated.to(self.device),
            ended,
            finals,
        )

    def close(self) -> None:
        """Release what the task holds."""
        self.env.close()
