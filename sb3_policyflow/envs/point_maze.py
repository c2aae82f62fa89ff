"""A maze with one start and four goals of equal reward, none of them observed.

The task of the paper's exploration figure, on the dynamics and walls of gymnasium-robotics' medium
maze (extra ``robotics``). The paper names ``PointMaze_Medium_Diverse_GDense-v3``, but that task
draws one of three goals for each episode and shows it to the agent, while the figure has one start
and four goals with equal rewards. This module assumes:

- The start is the stock map's, ``START_CELL``, without the stock task's noise: each episode begins
  at rest at the center of that cell.
- Three goals are the stock map's. For the fourth, which the paper does not locate, the free cell is
  taken that is farthest from the start along the corridors among those at least two cells from
  every other goal. All lie at the centers of their cells.
- The reward is the stock one, ``exp(-distance)``, of the distance to the nearest goal.
- Reaching a goal ends nothing; an episode is truncated after 600 steps, as in the stock task.
- The observation is the stock one without its goals: ``[x, y, v_x, v_y]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_policyflow.envs.drawing import draw_maze
from sb3_policyflow.envs.extras import import_extra
from sb3_policyflow.envs.type_aliases import Float32Array, FloatArray, Info

if TYPE_CHECKING:
    from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv

Cell = tuple[int, int]

ENV_ID = "PointMazeMultiGoal-Medium-v0"
START_CELL: Cell = (1, 1)
GOAL_CELLS: tuple[Cell, ...] = ((2, 6), (5, 1), (6, 3), (6, 5))
SUCCESS_RADIUS = 0.45
FRAME_SIZE = 480


def medium_maze() -> NDArray[np.bool_]:
    """Whether each cell of gymnasium-robotics' medium maze is free, rows from the top.

    Cells are squares of side 1, and the maze is centered on the origin.
    """
    import_extra("gymnasium_robotics", "robotics", ENV_ID)
    from gymnasium_robotics.envs.maze.maps import MEDIUM_MAZE

    free: NDArray[np.bool_] = np.array(MEDIUM_MAZE) == 0
    return free


def cell_center(cell: Cell, maze: NDArray[np.bool_]) -> FloatArray:
    """Position of the center of cell (row, column)."""
    row, column = cell
    n_rows, n_columns = maze.shape
    return np.array([column + 0.5 - n_columns / 2, n_rows / 2 - row - 0.5])


class PointMazeMultiGoalEnv(gym.Env[FloatArray, Float32Array]):
    """``PointMazeMultiGoal-Medium-v0``: see the module for the task and its assumptions.

    Observation ``[x, y, v_x, v_y]``, action ``[f_x, f_y]`` in ``[-1, 1]``. ``info["is_success"]``
    says whether the ball is within 0.45 of a goal, the stock task's radius. The time limit is that
    of ``gymnasium.make``.

    :param render_mode: ``None`` or ``"rgb_array"``, a view from above with the episode's trail.
    :param start_cell: Row and column of the start.
    :param goal_cells: Rows and columns of the goals.
    """

    metadata: Info = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        start_cell: Cell = START_CELL,
        goal_cells: Sequence[Cell] = GOAL_CELLS,
    ) -> None:
        self.maze = medium_maze()
        start_cell, *goal_cells = ((row, column) for row, column in (start_cell, *goal_cells))
        _require_free(self.maze, (start_cell, *goal_cells))
        self.start = cell_center(start_cell, self.maze)
        self.goals: FloatArray = np.stack([cell_center(cell, self.maze) for cell in goal_cells])
        self.simulation = _stock_environment(self.maze, start_cell, goal_cells)
        self.observation_space = self.simulation.observation_space["observation"]
        self.action_space = self.simulation.action_space
        self.render_mode = render_mode
        self._trail = [self.start]

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[FloatArray, Info]:
        super().reset(seed=seed)
        if options:
            raise ValueError(
                f"{ENV_ID} always begins at the same place: reset takes no options {options}, but "
                "gymnasium.make takes start_cell."
            )
        observation: FloatArray = self.simulation.reset(seed=seed)[0]["observation"]
        self._trail = [self.start]
        return observation, self._info(observation)

    def step(self, action: Float32Array) -> tuple[FloatArray, float, bool, bool, Info]:
        observation: FloatArray = self.simulation.step(action)[0]["observation"]
        if self.render_mode is not None:
            self._trail.append(observation[:2].copy())
        reward = float(np.exp(-self._distance(observation)))
        return observation, reward, False, False, self._info(observation)

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode is None:
            return None
        return draw_maze(self.maze, self.goals, np.array(self._trail), FRAME_SIZE)

    def close(self) -> None:
        self.simulation.close()

    def _distance(self, observation: FloatArray) -> float:
        return float(np.linalg.norm(observation[:2] - self.goals, axis=1).min())

    def _info(self, observation: FloatArray) -> Info:
        return {"is_success": self._distance(observation) <= SUCCESS_RADIUS}


def _stock_environment(
    maze: NDArray[np.bool_], start_cell: Cell, goal_cells: Sequence[Cell]
) -> PointMazeEnv:
    """Gymnasium-robotics' environment, whose ball and walls are used, and whose goal is not."""
    from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv

    maze_map: list[list[Any]] = np.where(maze, 0, 1).tolist()
    for row, column in goal_cells:
        maze_map[row][column] = "g"
    maze_map[start_cell[0]][start_cell[1]] = "r"
    environment = PointMazeEnv(maze_map, continuing_task=True, reset_target=False)
    environment.position_noise_range = 0.0
    return environment


def _require_free(maze: NDArray[np.bool_], cells: Sequence[Cell]) -> None:
    free = {(int(row), int(column)) for row, column in np.argwhere(maze)}
    walls = [cell for cell in cells if cell not in free]
    if walls or len(set(cells)) < len(cells) or len(cells) < 2:
        raise ValueError(
            "The start and the goals (at least one) must be different free cells (row, column) of "
            f"the maze, not {list(cells)}; free are {sorted(free)}."
        )
