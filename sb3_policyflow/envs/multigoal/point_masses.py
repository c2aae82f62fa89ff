"""MultiGoal's physics, rewards and goals, for a batch of points.

What is assumed where the paper is silent is listed in ``sb3_policyflow.envs.multigoal``.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_policyflow.envs.drawing import draw_multigoal
from sb3_policyflow.envs.type_aliases import Float32Array, FloatArray

DT = 0.1
MAX_EPISODE_STEPS = 50
MAX_ACTION = 5.0
WALL = 8.0
START_HALF_WIDTH = 7.0
SUCCESS_RADIUS = 1.0
_ANGLES = np.deg2rad(np.arange(0.0, 360.0, 60.0))
GOALS: FloatArray = 5.0 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
FRAME_SIZE = 480


def nearest_goal(positions: FloatArray) -> tuple[NDArray[np.int_], FloatArray]:
    """Index of the goal nearest to each position, and the squared distance to it.

    As all goals are equally far from the center, it is the one with the largest ``p . g``.

    :param positions: Shape (n, 2).
    :return: Two arrays of shape (n,).
    """
    nearest = (positions @ GOALS.T).argmax(axis=1)
    offset = positions - GOALS[nearest]
    return nearest, _squared_norm(offset)


def _squared_norm(vectors: FloatArray) -> FloatArray:
    squared: FloatArray = np.einsum("nd,nd->n", vectors, vectors)
    return squared


class Step(NamedTuple):
    """What one step of the batch returns, each of shape (num_envs,)."""

    rewards: FloatArray
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class PointMasses:
    """``num_envs`` points, each at a position with a velocity, pushed by accelerations.

    ``p' = p + v dt`` and ``v' = v + clip(a, -5, 5) dt``; the reward is
    ``dt (exp(-0.3 d^2) + exp(-0.1 d^2) - 0.01 |a|^2)`` with ``d`` the distance from ``p'`` to the
    nearest goal.

    :param num_envs: Number of points.
    :param max_episode_steps: Steps after which an episode is truncated.
    :param keep_trails: Whether to keep each episode's positions, for a picture.
    :raises ValueError: If a number is less than 1.
    """

    def __init__(self, num_envs: int, max_episode_steps: int, keep_trails: bool) -> None:
        if num_envs < 1 or max_episode_steps < 1:
            raise ValueError(
                "MultiGoal needs num_envs and max_episode_steps of at least 1, "
                f"not {num_envs} and {max_episode_steps}."
            )
        self.max_episode_steps = max_episode_steps
        self.states: FloatArray = np.zeros((num_envs, 4))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        length = max_episode_steps + 1 if keep_trails else 0
        self.trails: FloatArray = np.zeros((num_envs, length, 2))

    @property
    def positions(self) -> FloatArray:
        """A view on the states, shape (num_envs, 2)."""
        return self.states[:, :2]

    @property
    def velocities(self) -> FloatArray:
        """A view on the states, shape (num_envs, 2)."""
        return self.states[:, 2:]

    def observations(self) -> Float32Array:
        """``[x, y, v_x, v_y]`` of each point, shape (num_envs, 4); a copy."""
        return self.states.astype(np.float32)

    def reset(self, which: NDArray[np.int_], rng: np.random.Generator) -> None:
        """Put the points ``which`` at rest at random positions."""
        self.states[which, :2] = rng.uniform(-START_HALF_WIDTH, START_HALF_WIDTH, (len(which), 2))
        self.states[which, 2:] = 0.0
        self.steps[which] = 0
        self._extend_trails()

    def start(self, rng: np.random.Generator, options: Mapping[str, ArrayLike] | None) -> None:
        """Begin an episode with each point, from random states or from those in ``options``.

        :param options: ``position`` and ``velocity``, of shape (2,) or (num_envs, 2).
        :raises ValueError: For another key or shape, or a position outside the workspace.
        """
        options = options or {}
        if unknown := sorted(set(options) - {"position", "velocity"}):
            raise ValueError(
                f"MultiGoal's reset options are 'position' and 'velocity', not {unknown}."
            )
        self.reset(np.arange(len(self.states)), rng)
        for name, values in (("position", self.positions), ("velocity", self.velocities)):
            if name in options:
                values[:] = _as_points(name, options[name], len(self.states))
        if (np.abs(self.positions) > WALL).any():
            raise ValueError(f"Positions must lie inside the walls at {WALL}, not {options}.")
        self._extend_trails()

    def step(self, actions: ArrayLike) -> Step:
        """Advance all points by one step under ``actions``, shape (num_envs, 2)."""
        actions = np.asarray(actions, dtype=np.float64)
        self.positions[:] += self.velocities * DT
        self.velocities[:] += actions.clip(-MAX_ACTION, MAX_ACTION) * DT
        self.steps += 1
        self._extend_trails()
        outside = np.abs(self.positions).max(axis=1) > WALL
        return Step(self._rewards(actions), outside, self.steps >= self.max_episode_steps)

    def is_success(self) -> NDArray[np.bool_]:
        """Whether each point is within ``SUCCESS_RADIUS`` of a goal."""
        _, squared = nearest_goal(self.positions)
        return squared <= SUCCESS_RADIUS**2

    def draw(self, index: int) -> NDArray[np.uint8]:
        """Picture of one point's episode so far."""
        trail = self.trails[index, : self.steps[index] + 1]
        return draw_multigoal(GOALS, WALL, trail, FRAME_SIZE)

    def _rewards(self, actions: FloatArray) -> FloatArray:
        _, squared = nearest_goal(self.positions)
        closeness = np.exp(-0.3 * squared) + np.exp(-0.1 * squared)
        return DT * (closeness - 0.01 * _squared_norm(actions))

    def _extend_trails(self) -> None:
        if self.trails.size:
            # A single environment may be stepped past its end.
            steps = self.steps.clip(max=self.max_episode_steps)
            self.trails[np.arange(len(steps)), steps] = self.positions


def _as_points(name: str, value: ArrayLike, num_envs: int) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in {(2,), (num_envs, 2)} or not np.isfinite(array).all():
        raise ValueError(
            f"MultiGoal's reset option {name!r} must be finite numbers of shape (2,) "
            f"or ({num_envs}, 2), not {value!r}."
        )
    return array
