"""MultiGoal: a point mass on a plane with six equally good goals.

The task of the paper's multimodality test (appendix "MultiGoal Setups"), after Haarnoja et al.
(2017). Its dynamics are written once, for a batch; the single environment is a batch of one.

Where the paper is silent, this module assumes:

- The position moves with the velocity of the step before; then the velocity changes (explicit
  Euler). There is no friction and no speed limit.
- An episode starts at rest, uniformly in ``[-7, 7]^2``: inside the walls at 8, with some room.
- "Check wall collisions" means that leaving the workspace ends the episode: a termination, without
  a penalty (what is lost is the reward of the steps that would have followed).
- Reaching a goal does not end the episode: the agent is paid for staying.
- The reward is that of the position after the step, and each term is multiplied by ``DT``. The
  paper's returns (8.79) are on this scale: at most 0.2 a step and 10 an episode.
- The action penalty is that of the action received, before it is clipped to the bounds. (SB3's
  algorithms clip to the bounds themselves, before the environment sees the action.)
- The goals' angles are 0, 60, ..., 300 degrees.
- Success is to end within ``SUCCESS_RADIUS`` of a goal; the paper has no such number.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from sb3_policyflow.envs.drawing import draw_multigoal
from sb3_policyflow.envs.vector import GymVectorVecEnv, Info

FloatArray = NDArray[np.float64]
Observation = NDArray[np.float32]

DT = 0.1
MAX_EPISODE_STEPS = 50
MAX_ACTION = 5.0
WALL = 8.0
START_HALF_WIDTH = 7.0
SUCCESS_RADIUS = 1.0
_ANGLES = np.deg2rad(np.arange(0.0, 360.0, 60.0))
GOALS: FloatArray = 5.0 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
FRAME_SIZE = 480

OBSERVATION_SPACE = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
ACTION_SPACE = gym.spaces.Box(-MAX_ACTION, MAX_ACTION, (2,), np.float32)
METADATA: Info = {"render_modes": ["rgb_array"], "render_fps": 15}


def nearest_goal(positions: FloatArray) -> tuple[NDArray[np.int_], FloatArray]:
    """Index of the goal nearest to each position, and the squared distance to it.

    As all goals are equally far from the centre, it is the one with the largest ``p . g``.

    :param positions: shape ``(n, 2)``
    :return: two arrays of shape ``(n,)``
    """
    nearest = (positions @ GOALS.T).argmax(axis=1)
    offset = positions - GOALS[nearest]
    return nearest, _squared_norm(offset)


def _squared_norm(vectors: FloatArray) -> FloatArray:
    squared: FloatArray = np.einsum("nd,nd->n", vectors, vectors)
    return squared


class Step(NamedTuple):
    """What one step of the batch yields, each of shape ``(num_envs,)``."""

    rewards: FloatArray
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class PointMasses:
    """``num_envs`` points, each at a position with a velocity, pushed by accelerations.

    ``p' = p + v dt`` and ``v' = v + clip(a, -5, 5) dt``; the reward is
    ``dt (exp(-0.3 d^2) + exp(-0.1 d^2) - 0.01 |a|^2)`` with ``d`` the distance from ``p'`` to the
    nearest goal.

    :param num_envs: number of points
    :param max_episode_steps: steps after which an episode is truncated
    :param keep_trails: keep each episode's positions, for a picture
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
        """A view on the states, shape ``(num_envs, 2)``."""
        return self.states[:, :2]

    @property
    def velocities(self) -> FloatArray:
        """A view on the states, shape ``(num_envs, 2)``."""
        return self.states[:, 2:]

    def observations(self) -> Observation:
        """``[x, y, v_x, v_y]`` of each point, shape ``(num_envs, 4)``; a copy."""
        return self.states.astype(np.float32)

    def reset(self, which: NDArray[np.int_], rng: np.random.Generator) -> None:
        """Put the points ``which`` at rest at random positions."""
        self.states[which, :2] = rng.uniform(-START_HALF_WIDTH, START_HALF_WIDTH, (len(which), 2))
        self.states[which, 2:] = 0.0
        self.steps[which] = 0
        self._extend_trails()

    def place(self, position: ArrayLike | None = None, velocity: ArrayLike | None = None) -> None:
        """Set positions and velocities of all points, shape ``(2,)`` or ``(num_envs, 2)``.

        :raises ValueError: for another shape, or a position outside the workspace
        """
        if position is not None:
            self.positions[:] = _as_points("position", position, len(self.states))
            if (np.abs(self.positions) > WALL).any():
                raise ValueError(f"The position must lie inside the walls at {WALL}: {position}.")
        if velocity is not None:
            self.velocities[:] = _as_points("velocity", velocity, len(self.states))
        self._extend_trails()

    def step(self, actions: ArrayLike) -> Step:
        """Advance all points by one step under ``actions``, shape ``(num_envs, 2)``."""
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
            self.trails[np.arange(len(self.steps)), self.steps] = self.positions


def _as_points(name: str, value: ArrayLike, num_envs: int) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in {(2,), (num_envs, 2)} or not np.isfinite(array).all():
        raise ValueError(
            f"MultiGoal's reset option {name!r} must be finite numbers of shape (2,) "
            f"or ({num_envs}, 2), not {value!r}."
        )
    return array


def _reset(points: PointMasses, rng: np.random.Generator, options: Info | None) -> None:
    unknown = set(options or {}) - {"position", "velocity"}
    if unknown:
        raise ValueError(
            f"MultiGoal's reset options are 'position' and 'velocity', not {sorted(unknown)}."
        )
    points.reset(np.arange(len(points.states)), rng)
    points.place(**(options or {}))


class MultiGoalEnv(gym.Env[Observation, NDArray[np.float32]]):
    """``MultiGoal-v0``, one environment.

    Observation ``[x, y, v_x, v_y]``, action ``[a_x, a_y]`` in ``[-5, 5]``. ``info["is_success"]``
    says whether the point is within 1.0 of a goal. ``reset(options={"position": (x, y),
    "velocity": (v_x, v_y)})`` starts from a given state (either may be left out).

    The environment truncates itself. Under ``gymnasium.make``, whose time limit is a wrapper of the
    same length, an argument ``max_episode_steps`` can shorten an episode but not lengthen it.

    :param render_mode: ``None`` or ``"rgb_array"``
    :param max_episode_steps: steps after which an episode is truncated
    """

    metadata = METADATA

    def __init__(
        self, render_mode: str | None = None, max_episode_steps: int = MAX_EPISODE_STEPS
    ) -> None:
        self.observation_space = OBSERVATION_SPACE
        self.action_space = ACTION_SPACE
        self.render_mode = render_mode
        self.points = PointMasses(1, max_episode_steps, keep_trails=render_mode is not None)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        _reset(self.points, self.np_random, options)
        return self.points.observations()[0], self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        rewards, terminated, truncated = self.points.step(np.asarray(action)[None])
        observation = self.points.observations()[0]
        return (
            observation,
            float(rewards[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            self._info(),
        )

    def render(self) -> NDArray[np.uint8] | None:
        return None if self.render_mode is None else self.points.draw(0)

    def _info(self) -> Info:
        return {"is_success": bool(self.points.is_success()[0])}


class MultiGoalState(NamedTuple):
    """All that the future of a ``MultiGoalVectorEnv`` depends on, the actions apart."""

    states: FloatArray
    steps: NDArray[np.int64]
    trails: FloatArray
    generator: Mapping[str, Any]


class MultiGoalVectorEnv(gym.vector.VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """``MultiGoal-v0``, ``num_envs`` environments in one batch of arrays.

    Same-step autoreset: when an episode ends, the next one's first observation is returned, and
    ``infos["final_obs"]`` and ``infos["final_info"]["is_success"]`` hold the end of the one before.
    All environments draw from one random generator.

    :param num_envs: number of environments
    :param render_mode: ``None`` or ``"rgb_array"``
    :param max_episode_steps: steps after which an episode is truncated
    """

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        self.metadata = {**METADATA, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.points = PointMasses(num_envs, max_episode_steps, keep_trails=render_mode is not None)
        self.single_observation_space = OBSERVATION_SPACE
        self.single_action_space = ACTION_SPACE
        self.observation_space = batch_space(OBSERVATION_SPACE, num_envs)
        self.action_space = batch_space(ACTION_SPACE, num_envs)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        _reset(self.points, self.np_random, options)
        return self.points.observations(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        rewards, terminated, truncated = self.points.step(actions)
        infos: Info = {}
        done = terminated | truncated
        if done.any():
            infos = self._final_infos(done)
            self.points.reset(np.flatnonzero(done), self.np_random)
        return self.points.observations(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        if self.render_mode is None:
            return None
        return tuple(self.points.draw(i) for i in range(self.num_envs))

    def get_state(self) -> MultiGoalState:
        """A copy of the points, counters and random generator."""
        points = self.points
        return MultiGoalState(
            points.states.copy(),
            points.steps.copy(),
            points.trails.copy(),
            self.np_random.bit_generator.state,
        )

    def set_state(self, state: MultiGoalState) -> None:
        """Continue from what ``get_state`` returned."""
        self.points.states[:] = state.states
        self.points.steps[:] = state.steps
        self.points.trails[:] = state.trails
        self.np_random.bit_generator.state = state.generator

    def _final_infos(self, done: NDArray[np.bool_]) -> Info:
        final_obs = np.full(self.num_envs, None, dtype=object)
        observations = self.points.observations()
        for i in np.flatnonzero(done).tolist():
            final_obs[i] = observations[i]
        final_info = {"is_success": self.points.is_success() & done, "_is_success": done}
        return {
            "final_obs": final_obs,
            "_final_obs": done,
            "final_info": final_info,
            "_final_info": done,
        }


class MultiGoalVecEnv(GymVectorVecEnv):
    """``MultiGoal-v0`` as an SB3 ``VecEnv``: thousands of environments in one process.

    Wrap it in ``VecMonitor`` for episode statistics. ``set_options`` takes the reset options of
    ``MultiGoalEnv``: one dictionary for all environments, where a value may also have one row for
    each, or a list with one dictionary for each.

    :param num_envs: number of environments
    :param seed: seed of the first ``reset``; ``seed()`` sets another
    :param render_mode: ``None`` or ``"rgb_array"``
    :param max_episode_steps: steps after which an episode is truncated
    """

    env: MultiGoalVectorEnv

    def __init__(
        self,
        num_envs: int,
        seed: int | None = None,
        render_mode: str | None = None,
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        super().__init__(MultiGoalVectorEnv(num_envs, render_mode, max_episode_steps))
        self.seed(seed)

    def get_state(self) -> MultiGoalState:
        """All that the future depends on, the actions apart: points, counters, generator."""
        return self.env.get_state()

    def set_state(self, state: MultiGoalState) -> None:
        """Continue from what ``get_state`` returned, instead of ``reset``."""
        self.env.set_state(state)

    def _batch_options(self, options: Any) -> Info:
        return {key: np.stack([row[key] for row in options]) for key in options[0]}
