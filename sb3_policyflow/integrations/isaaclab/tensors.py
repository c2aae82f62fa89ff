"""IsaacLab's environments as they are: batches of tensors on the simulator's device."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_policyflow.envs.tensor import TensorObs, TensorStep, map_observations
from sb3_policyflow.resilience.saving import preserve_rng_state

GROUP = "policy"
"""The group of observations that a policy is given, as in IsaacLab's wrapper for SB3."""


class IsaacLabTensorEnv:
    """A ``ManagerBasedRLEnv`` or ``DirectRLEnv`` as a ``TensorVecEnv``.

    As an episode's last observation it has the next episode's first one, unless version 3 is
    configured with ``compute_final_obs``: without it, train with ``timeout_bootstrap="current"``.

    :param env: What ``gymnasium.make`` returned.
    :param action_bounds: Bounds for actions that have none, which SB3 needs.
    :raises ValueError: If observations are images, or no arrays.
    """

    def __init__(self, env: Any, action_bounds: tuple[float, float] = (-100.0, 100.0)) -> None:
        self.env = env
        inner = env.unwrapped
        self.num_envs: int = inner.num_envs
        self.device = th.device(inner.device)
        self.observation_space: gym.Space[Any] = inner.single_observation_space[GROUP]
        self.action_space: gym.Space[Any] = bounded(inner.single_action_space, action_bounds)
        if not are_vectors(self.observation_space):
            raise ValueError(
                f"Observations {self.observation_space} have to be brought into another form: use "
                "IsaacLab's isaaclab_rl.sb3.Sb3VecEnvWrapper in place of IsaacLabTensorEnv."
            )

    def seed(self, seed: int) -> None:
        """Seed what the simulation draws from now on.

        IsaacLab seeds Python's, NumPy's and torch's generators, too, from which a policy draws:
        these are put back.
        """
        with preserve_rng_state(self.device):
            self.env.unwrapped.seed(seed)

    def reset(self) -> TensorObs:
        observations, _ = self.env.reset()
        return _copied(observations)

    def step(self, actions: th.Tensor) -> TensorStep:
        observations, rewards, terminated, truncated, extras = self.env.step(actions)
        ended = (terminated | truncated).nonzero().flatten()
        last = extras["final_obs"] if len(ended) > 0 and "final_obs" in extras else observations
        return TensorStep(
            _copied(observations),
            rewards.float().clone(),
            terminated.clone(),
            truncated.clone(),
            ended,
            map_observations(lambda values: values[ended], last[GROUP]),
        )

    def close(self) -> None:
        """Close the environment; the simulator goes on."""
        self.env.close()


def bounded(space: gym.Space[Any], bounds: tuple[float, float]) -> gym.Space[Any]:
    """An action space with bounds, those that it has or others.

    :param space: The action space.
    :param bounds: For a Box that is not bounded.
    """
    if not isinstance(space, spaces.Box) or space.is_bounded("both"):
        return space
    low, high = bounds
    return spaces.Box(low, high, space.shape, np.float32)


def are_vectors(space: gym.Space[Any]) -> bool:
    """Whether observations are vectors of floats, or a dictionary of such vectors.

    :param space: Their space.
    """
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return all(
        isinstance(part, spaces.Box) and len(part.shape) == 1 and part.dtype == np.float32
        for part in parts
    )


def _copied(observations: dict[str, Any]) -> TensorObs:
    """The policy's observations, in memory that the simulation does not write to."""
    return map_observations(th.clone, observations[GROUP])
