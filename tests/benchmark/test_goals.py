"""Counting goals: hand-built trajectories, sampled ones, and their figures."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
import torch as th
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.benchmark.figures.goals import goals_figure
from sb3_policyflow.benchmark.measure.entropy import normalized_entropy
from sb3_policyflow.benchmark.measure.goals import (
    GoalReport,
    Trajectories,
    evaluate_goals,
    goal_counts,
    goal_report,
    sample_trajectories,
)
from sb3_policyflow.envs.drawing import GOAL_COLORS
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.envs.multigoal.point_masses import GOALS


def straight_to(ends: ArrayLike, n_steps: int = 10) -> Trajectories:
    """Straight lines from the center, all of the same length in steps; NaN afterwards."""
    n = len(np.asarray(ends))
    positions = np.full((n, 51, 2), np.nan)
    positions[:, : n_steps + 1] = np.linspace(0, ends, n_steps + 1, axis=1)
    return Trajectories(positions, np.full(n, n_steps), np.arange(n, dtype=float))


def towards(goal: ArrayLike, pull: float = 2.0) -> Any:
    """A controller that brakes on one goal, with ``predict`` as SB3's algorithms have it."""

    class Controller:
        def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
            action = pull * (goal - observation[:, :2]) - 2.5 * observation[:, 2:]
            return action.clip(-5, 5), None

    return Controller()


class Dice:
    """Accelerates at random, from torch's and numpy's global generators."""

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        shape = (len(observation), 2)
        return th.randn(shape).numpy() + np.random.standard_normal(shape), None


def seed_all() -> None:
    th.manual_seed(0)
    np.random.seed(0)


def test_counts_are_of_end_points_within_the_radius() -> None:
    ends = [GOALS[0], GOALS[0] + (0.0, 0.99), GOALS[3] - (0.5, 0.5), GOALS[5] + (1.01, 0.0)]
    trajectories = straight_to(ends)
    np.testing.assert_array_equal(goal_counts(trajectories), [2, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(goal_counts(trajectories, radius=1.1), [2, 0, 0, 1, 0, 1])
    np.testing.assert_array_equal(goal_counts(trajectories, radius=0.1), [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(trajectories.goals(), [0, 0, 3, -1])


def test_passing_a_goal_does_not_count() -> None:
    trajectories = straight_to([GOALS[2] * 1.5])
    assert goal_counts(trajectories).sum() == 0


@pytest.mark.parametrize(
    ("counts", "entropy"),
    [
        ([10, 10, 10, 10, 10, 10], 1.0),
        ([7, 0, 0, 0, 0, 0], 0.0),
        ([0, 0, 0, 0, 0, 0], 0.0),
        ([5, 5, 0, 0, 0, 0], np.log(2) / np.log(6)),
        ([3, 1], (0.75 * np.log(4 / 3) + 0.25 * np.log(4)) / np.log(2)),
    ],
)
def test_entropy_by_hand(counts: list[int], entropy: float) -> None:
    assert normalized_entropy(counts) == pytest.approx(entropy)


@pytest.mark.parametrize("counts", [[3], [1, -1], [[1, 2], [3, 4]], [np.nan, 1]])
def test_entropy_refuses_what_is_not_counts(counts: Any) -> None:
    with pytest.raises(ValueError, match="two or more counts"):
        normalized_entropy(counts)


@pytest.mark.parametrize("radius", [0.0, -1.0, 2.5])
def test_radius_must_single_out_a_goal(radius: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        goal_counts(straight_to([GOALS[0]]), radius)


def test_report_by_hand() -> None:
    report = goal_report(straight_to([GOALS[1], GOALS[1], GOALS[4], (0.0, 0.0)]))
    assert report.counts == (0, 2, 0, 0, 1, 0)
    assert (report.n_missed, report.share_missed, report.n_goals) == (1, 0.25, 2)
    assert report.entropy == pytest.approx(np.log(3 / 2 ** (2 / 3)) / np.log(6))
    assert report.mean_return == 1.5
    assert str(report).startswith("2 of 6 goals reached (0 2 0 0 1 0; no goal: 1)")
    kept = json.loads(json.dumps({**asdict(report), "n_goals": report.n_goals}))
    assert GoalReport.from_summary(kept) == report


@pytest.mark.parametrize("goal", range(6))
def test_a_controller_for_one_goal_reaches_that_goal(goal: int) -> None:
    trajectories = sample_trajectories(towards(GOALS[goal]), n=5)
    assert goal_report(trajectories).counts[goal] == 5
    np.testing.assert_array_equal(trajectories.lengths, 50)
    np.testing.assert_array_equal(trajectories.positions[:, 0], 0.0)
    assert not np.isnan(trajectories.positions).any()


def test_return_is_the_sum_of_the_rewards_of_one_episode() -> None:
    trajectories = sample_trajectories(towards((0.0, 0.0)), n=2)
    distance = 5.0
    reward = 0.1 * (np.exp(-0.3 * distance**2) + np.exp(-0.1 * distance**2))
    np.testing.assert_allclose(trajectories.returns, 50 * reward, rtol=1e-5)


def test_trajectories_stop_where_their_episode_does() -> None:
    trajectories = sample_trajectories(towards((40.0, 0.0)), n=3)
    # At full acceleration x = 5 dt^2 k (k - 1) / 2 after k steps.
    k = next(k for k in range(50) if 5 * 0.01 * k * (k - 1) / 2 > 8)
    np.testing.assert_array_equal(trajectories.lengths, k)
    assert (trajectories.ends()[:, 0] > 8).all()
    assert np.isnan(trajectories.positions[:, k + 1 :]).all()
    assert goal_report(trajectories).share_missed == 1.0


def test_same_seed_same_trajectories_and_the_callers_generators_untouched() -> None:
    seed_all()
    first = sample_trajectories(Dice(), n=20, seed=1).positions
    after = th.rand(1).item(), np.random.rand()
    np.testing.assert_array_equal(first, sample_trajectories(Dice(), n=20, seed=1).positions)
    assert not np.array_equal(first, sample_trajectories(Dice(), n=20, seed=2).positions)
    seed_all()
    assert after == (th.rand(1).item(), np.random.rand())


def test_a_deterministic_policy_has_one_trajectory() -> None:
    model = PPO("MlpPolicy", MultiGoalVecEnv(2), n_steps=8, batch_size=16, seed=0, device="cpu")
    drawn = sample_trajectories(model, n=10)
    single = sample_trajectories(model, n=10, deterministic=True)
    assert len(np.unique(drawn.ends().round(3), axis=0)) == 10
    assert len(np.unique(single.ends().round(3), axis=0)) == 1


def test_observations_are_normalized_as_in_training() -> None:
    env = VecNormalize(MultiGoalVecEnv(2, seed=0), norm_reward=False)
    env.reset()
    env.obs_rms.mean[:] = 3.0
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=16, seed=0, device="cpu")
    seen = []
    predict = model.policy.predict
    model.policy.predict = lambda obs, *args: (seen.append(obs), predict(obs, *args))[1]
    evaluate_goals(model, n=2)
    np.testing.assert_allclose(seen[0], env.normalize_obs(np.zeros((2, 4))))


# Figures


def rendered(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255


def area_of(picture: np.ndarray, color: ArrayLike) -> int:
    return int((np.abs(picture - np.array(color)).max(axis=-1) < 0.02).sum())


def test_goals_figure_has_a_panel_for_each_run() -> None:
    runs = {name: straight_to(GOALS) for name in "abcd"}
    figure = goals_figure(runs)
    titles = [axes.get_title() for axes in figure.get_axes() if axes.get_title()]
    labels = [axes.get_xlabel() for axes in figure.get_axes() if axes.get_xlabel()]
    assert titles == list("abcd")
    assert labels == ["entropy 1.00   return 2.5   no goal 0.0%"] * 4


def test_goals_figure_gives_trajectories_the_color_of_their_goal() -> None:
    nothing = rendered(goals_figure({"": straight_to([(0.0, 0.0)])}))
    one = rendered(goals_figure({"": straight_to([GOALS[2]])}))
    grown = [area_of(one, color) - area_of(nothing, color) for color in GOAL_COLORS]
    assert np.argmax(grown) == 2
    assert grown[2] > 1000, "a bar of one"
    assert max(abs(change) for i, change in enumerate(grown) if i != 2) < 100
