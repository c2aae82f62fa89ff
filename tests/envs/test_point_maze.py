"""The four-goal maze against gymnasium-robotics' own, and the registration of stock mazes."""

import subprocess
import sys
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import ArrayLike, NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_policyflow.envs import ensure_registered
from sb3_policyflow.envs.drawing import GOAL_COLORS, Canvas
from sb3_policyflow.envs.vector import GymVectorVecEnv

pytest.importorskip("gymnasium_robotics")

from sb3_policyflow.envs.point_maze import (
    ENV_ID,
    FRAME_SIZE,
    GOAL_CELLS,
    START_CELL,
    PointMazeMultiGoalEnv,
    cell_center,
    medium_maze,
)

STOCK_ID = "PointMaze_Medium_Diverse_GDense-v3"


def stock() -> Any:
    ensure_registered(STOCK_ID)
    return gym.make(STOCK_ID).unwrapped


def pushes(n_steps: int, seed: int = 0) -> NDArray[np.float32]:
    """Random forces, each held for 20 steps, so that the ball gets somewhere and hits walls."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.2, 1.2, (n_steps // 20, 2)), 20, axis=0).astype(np.float32)


def test_moves_as_the_stock_maze_does() -> None:
    ours, theirs = PointMazeMultiGoalEnv(), stock()
    theirs.reset(seed=0)
    observation, _ = ours.reset(seed=0)
    theirs.point_env.set_state(observation[:2], observation[2:])
    visited = set()
    for action in pushes(600):
        observation, *_ = ours.step(action)
        np.testing.assert_array_equal(observation, theirs.step(action)[0]["observation"])
        visited.add(tuple(np.floor(observation[:2])))
    assert len(visited) > 5, "the comparison must leave the first cells"


def test_reward_is_of_the_nearest_of_four_goals() -> None:
    env = PointMazeMultiGoalEnv()
    env.reset()
    for i, goal in enumerate(env.goals):
        env.simulation.point_env.set_state(goal + np.array([0.3, 0.0]), np.zeros(2))
        observation, reward, terminated, truncated, info = env.step(np.zeros(2))
        distances = np.linalg.norm(observation[:2] - env.goals, axis=1)
        assert distances.argmin() == i
        assert reward == pytest.approx(np.exp(-0.3), rel=1e-3)
        assert (terminated, truncated, info["is_success"]) == (False, False, True)
    env.simulation.point_env.set_state(env.goals[0] - np.array([0.46, 0.0]), np.zeros(2))
    assert not env.step(np.zeros(2))[-1]["is_success"]


def test_every_episode_starts_at_rest_at_one_point() -> None:
    env = PointMazeMultiGoalEnv()
    starts = [env.reset(seed=seed)[0] for seed in (0, 1, None)]
    np.testing.assert_array_equal(starts, [[-2.5, 2.5, 0.0, 0.0]] * 3)


def test_start_and_three_goals_are_the_stock_maps() -> None:
    maze, theirs = medium_maze(), stock().maze
    np.testing.assert_array_equal(
        cell_center(START_CELL, maze), theirs.unique_reset_locations[0], strict=True
    )
    ours = {tuple(cell_center(cell, maze)) for cell in GOAL_CELLS}
    assert {tuple(goal) for goal in theirs.unique_goal_locations} < ours
    assert len(ours) == 4


def corridor_lengths(maze: NDArray[np.bool_], start: tuple[int, int]) -> dict[tuple[int, int], int]:
    lengths, queue = {start: 0}, deque([start])
    while queue:
        row, column = queue.popleft()
        for cell in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if maze[cell] and cell not in lengths:
                lengths[cell] = lengths[row, column] + 1
                queue.append(cell)
    return lengths


def test_fourth_goal_is_the_farthest_cell_apart_from_the_others() -> None:
    lengths = corridor_lengths(medium_maze(), START_CELL)
    others = [cell for cell in GOAL_CELLS if cell != (6, 3)]
    apart = [c for c in lengths if min(np.hypot(*np.subtract(c, o)) for o in others) >= 2]
    longest = max(lengths[cell] for cell in apart)
    assert [cell for cell in apart if lengths[cell] == longest] == [(6, 3)]


def test_observation_is_flat_and_hides_the_goals() -> None:
    env = gym.make(ENV_ID)
    assert env.observation_space.shape == (4,)
    assert env.action_space == gym.spaces.Box(-1, 1, (2,), np.float32)
    assert env.spec.max_episode_steps == 600


def test_truncates_at_six_hundred_steps_and_never_terminates() -> None:
    env = gym.make(ENV_ID)
    env.reset()
    ends = [env.step(action)[2:4] for action in pushes(600)]
    assert ends == [(False, False)] * 599 + [(False, True)]


@pytest.mark.parametrize(
    "kwargs",
    [
        {"start_cell": (0, 0)},
        {"goal_cells": [(1, 1)]},
        {"goal_cells": [(9, 9)]},
        {"goal_cells": []},
    ],
)
def test_cells_must_be_free_and_different(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="different free cells"):
        PointMazeMultiGoalEnv(**kwargs)


def test_cells_may_be_lists_as_in_a_yaml_file() -> None:
    env = PointMazeMultiGoalEnv(start_cell=[1, 2], goal_cells=[[2, 6], [5, 1]])
    np.testing.assert_array_equal(env.start, [-1.5, 2.5])
    np.testing.assert_array_equal(env.goals, [[2.5, 1.5], [-2.5, -1.5]])


def test_reset_options_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no options .*reset_cell.* takes start_cell"):
        PointMazeMultiGoalEnv().reset(options={"reset_cell": [2, 6]})


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_environment_checkers_pass() -> None:
    gymnasium_check_env(gym.make(ENV_ID, render_mode="rgb_array").unwrapped)
    sb3_check_env(PointMazeMultiGoalEnv())


def test_picture_shows_walls_goals_and_ball() -> None:
    env = PointMazeMultiGoalEnv(render_mode="rgb_array")
    env.reset()
    frame = env.render()
    assert frame.shape == (FRAME_SIZE, FRAME_SIZE, 3)

    def at(point: ArrayLike) -> NDArray[np.float64]:
        column, row = Canvas(FRAME_SIZE, 4.0).pixel(point).round().astype(int)
        return frame[row, column] / 255

    for goal in env.goals:
        np.testing.assert_allclose(at(goal), GOAL_COLORS[4], atol=0.01)
    assert at(env.start).max() < 0.3
    assert at((-1.5, 1.5)).min() == 1.0, "a free cell"
    assert at((-0.5, 2.5)).max() < 0.95, "a wall"
    for action in pushes(40):
        env.step(action)
    assert not np.array_equal(env.render(), frame)


def test_stock_maze_trains_from_its_dictionary_observation() -> None:
    ensure_registered(STOCK_ID)
    env = make_vec_env(STOCK_ID, n_envs=2, seed=0)
    PPO("MultiInputPolicy", env, n_steps=32, batch_size=32, n_epochs=1, device="cpu").learn(64)


def test_vector_adapter_equals_dummy_vec_env_with_dictionary_observations() -> None:
    ensure_registered(STOCK_ID)
    makers = [lambda: gym.make(STOCK_ID, max_episode_steps=15)] * 2
    ours = GymVectorVecEnv(SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP))
    dummy = DummyVecEnv(makers)
    for env in (ours, dummy):
        env.seed(3)
        env.reset()
    for action in pushes(40):
        one, other = ours.step([action] * 2), dummy.step(np.stack([action] * 2))
        assert_same(one[0], other[0])
        assert_same(dict(enumerate(one[3])), dict(enumerate(other[3])))
    assert_same(dict(enumerate(ours.reset_infos)), dict(enumerate(dummy.reset_infos)))


def assert_same(one: dict[Any, Any], other: dict[Any, Any]) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        if isinstance(value, dict):
            assert_same(value, other[key])
        else:
            np.testing.assert_array_equal(value, other[key])


# Registration


@pytest.mark.slow
def test_stock_mazes_are_registered_on_request_only() -> None:
    code = f"""
import sys, gymnasium as gym, sb3_policyflow
from sb3_policyflow.envs import ensure_registered
assert not {{"gymnasium_robotics", "mujoco"}} & set(sys.modules)
for env_id in ("CartPole-v1", "MultiGoal-v0", "{ENV_ID}"):
    ensure_registered(env_id)
assert "gymnasium_robotics" not in sys.modules
for _ in range(2):
    ensure_registered("{STOCK_ID}")
gym.make("{STOCK_ID}")
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_mistyped_maze_gets_the_nearest_names() -> None:
    ensure_registered("PointMaze-Medium-Diverse-GDense-v3")
    with pytest.raises(gym.error.NameNotFound, match="PointMaze_Medium_Diverse_GDense"):
        gym.make("PointMaze-Medium-Diverse-GDense-v3")
