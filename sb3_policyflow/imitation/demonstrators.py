"""Scripted demonstrators of this package's tasks, each of which goes to all of the task's goals."""

from abc import ABC, abstractmethod
from collections import deque
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_policyflow.common.checks import at_least
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.envs.multigoal.point_masses import DT, GOALS
from sb3_policyflow.envs.point_maze import (
    ENV_ID,
    GOAL_CELLS,
    Cell,
    cell_center,
    medium_maze,
)
from sb3_policyflow.envs.type_aliases import FloatArray
from sb3_policyflow.flows.choices import choose
from sb3_policyflow.imitation.episodes import Episode, run_episodes


class Style(NamedTuple):
    """How a demonstrator moves.

    :param stiffness: Action for each unit of distance to where it goes.
    :param damping: Action for each unit of speed, against it.
    :param max_action: Greatest action in each direction.
    :param noise: Standard deviation of noise on the actions.
    """

    stiffness: float
    damping: float
    max_action: float
    noise: float = 0.0


class Demonstrator(ABC):
    """Chooses a goal when an episode starts, and goes there as a spring with a damper would.

    :param style: How it moves.
    :param seed: Seed of goals and noise.
    """

    def __init__(self, style: Style, seed: int) -> None:
        self._style, self._rng = style, np.random.default_rng(seed)

    def __call__(self, observations: FloatArray, starts: NDArray[np.bool_]) -> FloatArray:
        """Actions in some states.

        :param observations: Positions and velocities, shape (n, 4).
        :param starts: Where an episode starts, shape (n,).
        :return: Shape (n, 2).
        """
        states = np.asarray(observations, dtype=np.float64)
        style, offsets = self._style, self.targets(states, starts) - states[:, :2]
        actions = style.stiffness * offsets - style.damping * states[:, 2:]
        actions = actions.clip(-style.max_action, style.max_action)
        noisy: FloatArray = actions + style.noise * self._rng.standard_normal(actions.shape)
        return noisy

    @abstractmethod
    def targets(self, states: FloatArray, starts: NDArray[np.bool_]) -> FloatArray:
        """Where to go next from each state, shape (n, 2)."""


MULTI_GOAL_STYLES = {
    "good": Style(stiffness=6.0, damping=4.5, max_action=5.0),
    "slow": Style(stiffness=1.0, damping=2.5, max_action=1.0),
    "noisy": Style(stiffness=6.0, damping=4.5, max_action=5.0, noise=1.0),
}
INDECISION = 1.0
"""Of goals further away than the nearest by this much, e times fewer are chosen."""


class MultiGoalDemonstrator(Demonstrator):
    """Goes to one of MultiGoal's six goals, which it chooses with probability ~ exp(-d).

    d is the distance: from the center all six are alike, and far from it the nearest is chosen.
    """

    _goals: FloatArray

    def targets(self, states: FloatArray, starts: NDArray[np.bool_]) -> FloatArray:
        if starts.all():
            self._goals = np.zeros_like(states[:, :2])
        distances = np.linalg.norm(states[starts, None, :2] - GOALS, axis=-1)
        gumbel = self._rng.gumbel(size=distances.shape)
        self._goals[starts] = GOALS[(gumbel - distances / INDECISION).argmax(axis=1)]
        # An action moves the velocity, and the position no earlier than a step later.
        return self._goals - DT * states[:, 2:]


POINT_MAZE_STYLES = {
    "good": Style(stiffness=4.0, damping=1.0, max_action=1.0),
    "slow": Style(stiffness=4.0, damping=2.0, max_action=0.5),
    "noisy": Style(stiffness=4.0, damping=1.0, max_action=1.0, noise=0.3),
}


class PointMazeDemonstrator(Demonstrator):
    """Goes to one of the maze's four goals, all equally often, by a shortest path of cells."""

    _chosen: NDArray[np.int64]

    def __init__(self, style: Style, seed: int) -> None:
        super().__init__(style, seed)
        self._maze = medium_maze()
        self._next = [next_cells(self._maze, goal) for goal in GOAL_CELLS]

    def targets(self, states: FloatArray, starts: NDArray[np.bool_]) -> FloatArray:
        if starts.all():
            self._chosen = np.zeros(len(states), dtype=np.int64)
        self._chosen[starts] = self._rng.integers(len(GOAL_CELLS), size=starts.sum())
        cells = [self._cell(position) for position in states[:, :2]]
        following = [
            self._next[goal].get(cell, cell) for goal, cell in zip(self._chosen, cells, strict=True)
        ]
        return np.stack([cell_center(cell, self._maze) for cell in following])

    def _cell(self, position: FloatArray) -> Cell:
        n_rows, n_columns = self._maze.shape
        row, column = n_rows / 2 - position[1], position[0] + n_columns / 2
        return int(np.floor(row)), int(np.floor(column))


def next_cells(maze: NDArray[np.bool_], goal: Cell) -> dict[Cell, Cell]:
    """The cell after each free one on a shortest path to a goal, which goes on to itself.

    >>> next_cells(np.array([[True, True], [False, True]]), (1, 1))
    {(1, 1): (1, 1), (0, 1): (1, 1), (0, 0): (0, 1)}

    :param maze: Whether each cell is free.
    :param goal: Row and column of the goal.
    """
    following, queue = {goal: goal}, deque([goal])
    while queue:
        row, column = cell = queue.popleft()
        for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            other = row + step[0], column + step[1]
            inside = 0 <= other[0] < maze.shape[0] and 0 <= other[1] < maze.shape[1]
            if inside and maze[other] and other not in following:
                following[other] = cell
                queue.append(other)
    return following


STYLES = {"MultiGoal-v0": MULTI_GOAL_STYLES, ENV_ID: POINT_MAZE_STYLES}
"""Styles by task and name."""
DEFAULT_EPISODES = {"MultiGoal-v0": 4096, ENV_ID: 200}
"""How many episodes are enough to learn a task's modes from."""


def make_env(env_id: str, n_envs: int, seed: int) -> VecEnv:
    """The environments of a task that has a demonstrator."""
    choose("env", env_id, STYLES)
    if env_id == ENV_ID:
        env: VecEnv = DummyVecEnv([lambda: gym.make(ENV_ID)] * n_envs)
        env.seed(seed)
        return env
    return MultiGoalVecEnv(n_envs, seed=seed)


def demonstrate(
    env_id: str, style: str = "good", n_episodes: int | None = None, seed: int = 0
) -> list[Episode]:
    """Episodes of a scripted demonstrator.

    :param env_id: "MultiGoal-v0" or "PointMazeMultiGoal-Medium-v0".
    :param style: "good", "slow" (about half the speed) or "noisy".
    :param n_episodes: How many; enough to learn the task's modes from by default.
    :param seed: Seed of starts, goals and noise.
    :raises ValueError: If there is no such demonstrator.
    """
    styles = choose("env", env_id, STYLES)
    chosen = choose("style", style, styles)
    n_episodes = DEFAULT_EPISODES[env_id] if n_episodes is None else n_episodes
    at_least(1)("n_episodes", n_episodes)
    is_maze = env_id == ENV_ID
    demonstrator = (PointMazeDemonstrator if is_maze else MultiGoalDemonstrator)(chosen, seed)
    env = make_env(env_id, min(n_episodes, 8 if is_maze else 1024), seed)
    box: Any = env.action_space

    def act(observations: FloatArray, starts: NDArray[np.bool_]) -> FloatArray:
        return demonstrator(observations, starts).clip(box.low, box.high).astype(box.dtype)

    episodes = run_episodes(env, act, n_episodes)
    env.close()
    return episodes
