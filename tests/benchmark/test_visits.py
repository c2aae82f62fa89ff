"""Visit maps of the maze: counted by hand, over real trainings, and drawn."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

pytest.importorskip("gymnasium_robotics")

from sb3_policyflow.benchmark.figures.visits import density_figure
from sb3_policyflow.benchmark.measure.visits import CELL_SIZE, VisitCounter, VisitMap
from sb3_policyflow.envs import ensure_registered
from sb3_policyflow.envs.point_maze import ENV_ID

FREE = np.array([[True, True, False], [True, False, True]])


class Recorder(gym.Wrapper):
    """Keeps the positions after each step, and shortens the episodes."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.positions: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, _, info = self.env.step(action)
        self.positions.append(observation[:2].copy())
        return observation, reward, terminated, len(self.positions) % 10 == 0, info


def test_numbers_by_hand() -> None:
    visits = VisitMap(np.array([[2, 2, 0], [0, 0, 4]]), FREE)
    assert visits.coverage == 0.75
    assert visits.entropy == pytest.approx(1.5 * np.log(2) / np.log(4))
    np.testing.assert_array_equal(visits.density, [[1, 1, np.nan], [0, np.nan, 2]])


def test_nothing_visited_and_all_alike() -> None:
    nothing, alike = VisitMap(np.zeros((2, 3), int), FREE), VisitMap(7 * FREE.astype(int), FREE)
    assert (nothing.coverage, nothing.entropy) == (0.0, 0.0)
    assert (alike.coverage, alike.entropy) == (1.0, pytest.approx(1.0))
    assert np.nanmax(nothing.density) == 0.0


def test_save_and_load(tmp_path: Path) -> None:
    visits = VisitMap(np.arange(6).reshape(2, 3), FREE)
    visits.save(tmp_path / "visits.npz")
    loaded = VisitMap.load(tmp_path / "visits.npz")
    np.testing.assert_array_equal(loaded.counts, visits.counts)
    np.testing.assert_array_equal(loaded.free, visits.free)


def model_on(env: VecEnv) -> PPO:
    return PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")


def counted(model: PPO, total_timesteps: int) -> VisitMap:
    counter = VisitCounter()
    model.learn(total_timesteps, callback=counter)
    return counter.visits()


@pytest.mark.parametrize("normalized", [False, True])
def test_counts_where_each_step_of_a_training_ended(normalized: bool) -> None:
    env = make_vec_env(ENV_ID, n_envs=2, seed=0, wrapper_class=Recorder)
    model = model_on(VecNormalize(env) if normalized else env)
    visits = counted(model, 512)
    steps = np.concatenate(env.get_attr("positions"))
    assert visits.counts.sum() == len(steps) == 512
    expected = np.zeros_like(visits.counts)
    for x, y in steps:
        expected[int((4.0 - y) // CELL_SIZE), int((x + 4.0) // CELL_SIZE)] += 1
    np.testing.assert_array_equal(visits.counts, expected)
    assert not visits.counts[~visits.free].any(), "no ball is in a wall"
    assert 0 < visits.coverage < 1


def test_free_cells_are_the_mazes_sixteen_to_one() -> None:
    visits = VisitCounter().visits()
    assert visits.free.sum() == 26 * 16
    assert visits.free[4, 4], "the start's cell"
    assert not visits.free[0].any()


def test_counts_the_stock_mazes_dictionary_observations() -> None:
    stock = "PointMaze_Medium_Diverse_GDense-v3"
    ensure_registered(stock)
    env = make_vec_env(stock, n_envs=2, seed=0)
    model = PPO("MultiInputPolicy", env, n_steps=16, batch_size=32, n_epochs=1, device="cpu")
    visits = counted(model, 32)
    assert visits.counts[4:8, 4:8].sum() == 32, "all near the start after 16 steps"


def test_figure_has_a_panel_for_each_run_on_one_scale() -> None:
    empty = VisitCounter().visits()
    all_alike = VisitMap(empty.free.astype(int), empty.free)
    figure = density_figure({"none": empty, "all": all_alike, "both": [empty, all_alike]})
    *panels, _ = figure.get_axes()
    assert [panel.get_title() for panel in panels] == ["none", "all", "both"]
    assert [panel.get_xlabel() for panel in panels] == [
        "visited 0.0%   entropy 0.00",
        "visited 100.0%   entropy 1.00",
        "visited 50.0%   entropy 0.50",
    ]
    images = [panel.get_images()[0] for panel in panels]
    assert len({image.get_clim() for image in images}) == 1
    middle = [image.to_rgba(image.get_array())[4, 4, :3] for image in images]
    np.testing.assert_allclose(middle[0], to_rgb("#F2B8A0"))  # unvisited cells can be seen
    assert middle[1].sum() < middle[2].sum() < 3.0, "twice as dense is darker"
