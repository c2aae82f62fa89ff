"""MultiGoal: its physics, its episodes, and that its three forms are one environment."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from numpy.typing import ArrayLike, NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

import sb3_policyflow  # noqa: F401  # registers
from sb3_policyflow.envs.drawing import GOAL_COLORS, Canvas
from sb3_policyflow.envs.multigoal import MultiGoalEnv, MultiGoalVecEnv, MultiGoalVectorEnv
from sb3_policyflow.envs.multigoal.point_masses import FRAME_SIZE, GOALS, WALL, nearest_goal

STILL = np.zeros(2, dtype=np.float32)


def started(position: ArrayLike, velocity: ArrayLike = (0.0, 0.0), **kwargs: Any) -> MultiGoalEnv:
    env = MultiGoalEnv(**kwargs)
    env.reset(seed=0, options={"position": position, "velocity": velocity})
    return env


def random_actions(num_envs: int, n_steps: int, seed: int = 0) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-5, 5, (n_steps, num_envs, 2)).astype(np.float32)


# Physics and reward


def test_one_step_by_hand() -> None:
    env = started(position=(1.0, -2.0), velocity=(3.0, 0.5))
    observation, *_ = env.step(np.array([2.0, -9.0], dtype=np.float32))
    # Position with the old velocity; the second acceleration is clipped to -5.
    np.testing.assert_allclose(observation, [1.3, -1.95, 3.2, 0.0], rtol=1e-6)


def test_reward_by_hand() -> None:
    env = started(position=(5.0, 0.0), velocity=(0.0, 10.0))
    _, reward, *_ = env.step(np.array([3.0, 4.0], dtype=np.float32))
    # New position (5, 1): distance 1 to the goal at (5, 0); |a|^2 = 25.
    assert reward == pytest.approx(0.1 * (np.exp(-0.3) + np.exp(-0.1) - 0.25))


def test_action_penalty_is_of_the_unclipped_action() -> None:
    env = started(position=(5.0, 0.0))
    _, reward, *_ = env.step(np.array([30.0, 40.0], dtype=np.float32))
    assert reward == pytest.approx(0.1 * (2.0 - 25.0))


def test_resting_on_a_goal_pays_ten_an_episode() -> None:
    env = started(position=GOALS[4])
    steps = [env.step(STILL) for _ in range(50)]
    assert sum(reward for _, reward, *_ in steps) == pytest.approx(10.0)
    assert [terminated for _, _, terminated, *_ in steps] == [False] * 50
    assert steps[-1][-1]["is_success"] is True


def test_goals_lie_on_a_circle_sixty_degrees_apart() -> None:
    np.testing.assert_allclose(GOALS[:2], [[5.0, 0.0], [2.5, 4.330127]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(GOALS, axis=1), 5.0)
    np.testing.assert_allclose(np.linalg.norm(GOALS - np.roll(GOALS, 1, axis=0), axis=1), 5.0)


def test_nearest_goal_equals_brute_force() -> None:
    positions = np.random.default_rng(0).uniform(-9, 9, (1000, 2))
    distances = np.linalg.norm(positions[:, None] - GOALS, axis=-1)
    nearest, squared = nearest_goal(positions)
    np.testing.assert_array_equal(nearest, distances.argmin(axis=1))
    np.testing.assert_allclose(np.sqrt(squared), distances.min(axis=1), atol=1e-9)


# Episodes


def test_starts_at_rest_inside_the_walls() -> None:
    observations = MultiGoalVecEnv(5000, seed=1).reset()
    assert np.abs(observations[:, :2]).max() <= 7.0
    np.testing.assert_allclose(observations[:, :2].mean(axis=0), 0.0, atol=0.2)
    np.testing.assert_allclose(observations[:, :2].std(axis=0), 7 / np.sqrt(3), rtol=0.03)
    assert not observations[:, 2:].any()


def test_truncates_after_exactly_fifty_steps() -> None:
    env = started(position=(0.0, 0.0))
    ends = [env.step(STILL)[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_leaving_the_workspace_terminates_without_penalty(direction: tuple[int, int]) -> None:
    env = started(position=7.9 * np.array(direction), velocity=2.0 * np.array(direction))
    observation, reward, terminated, truncated, info = env.step(STILL)
    assert np.abs(observation[:2]).max() > WALL
    assert (terminated, truncated) == (True, False)
    assert reward > 0.0
    assert info["is_success"] is False


def test_success_radius_is_one() -> None:
    assert started(position=(5.0, 0.99)).step(STILL)[-1]["is_success"]
    assert not started(position=(5.0, 1.01)).step(STILL)[-1]["is_success"]


def test_same_seed_same_trajectories_and_another_seed_others() -> None:
    def rollout(seed: int) -> list[Any]:
        env = MultiGoalVecEnv(16, seed=seed)
        return [env.reset(), *(env.step(a)[0] for a in random_actions(16, 120))]

    first, again, other = rollout(3), rollout(3), rollout(4)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])
    assert not np.array_equal(first[-1], other[-1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"postion": (0, 0)}, "postion"),
        ({"position": (0, 0, 0)}, "shape"),
        ({"position": (9, 0)}, "walls"),
        ({"velocity": (np.nan, 0)}, "finite"),
    ],
)
def test_bad_reset_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MultiGoalEnv().reset(options=options)


@pytest.mark.parametrize("kwargs", [{"num_envs": 0}, {"num_envs": 1, "max_episode_steps": 0}])
def test_bad_sizes_are_refused(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        MultiGoalVecEnv(**kwargs)


# The batch, the single environment and SB3's VecEnv


def test_a_batch_equals_single_environments() -> None:
    starts = np.random.default_rng(2).uniform(-7, 7, (8, 2))
    batch = MultiGoalVectorEnv(8)
    batch.reset(options={"position": starts})
    singles = [started(position) for position in starts]
    alive = np.ones(8, dtype=bool)
    for actions in random_actions(8, 50):
        observations, rewards, terminated, truncated, infos = batch.step(actions)
        for i in np.flatnonzero(alive):
            single = singles[i].step(actions[i])
            done = single[2] or single[3]
            last = infos["final_obs"][i] if done else observations[i]
            np.testing.assert_array_equal(last, single[0])
            assert (rewards[i], terminated[i], truncated[i]) == single[1:4]
            if done:
                assert infos["final_info"]["is_success"][i] == single[4]["is_success"]
        alive &= ~(terminated | truncated)
    assert not alive.any()


class Scripted(gym.Wrapper):
    """Starts every episode where the n-th episode of a recorded run started."""

    def __init__(self, env: Any, starts: Sequence[Any]) -> None:
        super().__init__(env)
        self.starts = iter(starts)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        del options
        return self.env.reset(seed=seed, options={"position": next(self.starts)})


def test_vec_env_equals_dummy_vec_env_through_episode_ends() -> None:
    ours = MultiGoalVecEnv(4, seed=0)
    records, starts = [], [[row[:2]] for row in ours.reset()]
    for actions in random_actions(4, 200):
        records.append(ours.step(actions))
        for i in np.flatnonzero(records[-1][2]):
            starts[i].append(records[-1][0][i, :2])

    dummy = DummyVecEnv([lambda i=i: Scripted(MultiGoalEnv(), starts[i]) for i in range(4)])
    dummy.reset()
    n_ends = 0
    for actions, (observations, rewards, dones, infos) in zip(
        random_actions(4, 200), records, strict=True
    ):
        expected = dummy.step(actions)
        # Starts are handed over in float32, so the reference may differ in its last digit.
        np.testing.assert_allclose(observations, expected[0], atol=1e-5)
        np.testing.assert_allclose(rewards, expected[1], atol=1e-6)
        assert rewards.dtype == expected[1].dtype
        np.testing.assert_array_equal(dones, expected[2])
        for i in range(4):
            assert infos[i]["TimeLimit.truncated"] is expected[3][i]["TimeLimit.truncated"]
        for i in np.flatnonzero(dones):
            n_ends += 1
            assert set(infos[i]) == set(expected[3][i])
            assert infos[i]["is_success"] == expected[3][i]["is_success"]
            np.testing.assert_allclose(
                infos[i]["terminal_observation"], expected[3][i]["terminal_observation"], atol=1e-5
            )
    assert n_ends > 8


def test_leaving_at_the_last_step_is_a_termination() -> None:
    env = MultiGoalVecEnv(2, max_episode_steps=1)
    env.set_options({"position": [(7.9, 0.0), (0.0, 0.0)], "velocity": (5.0, 0.0)})
    env.reset()
    _, _, dones, infos = env.step(np.zeros((2, 2)))
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True]


def test_options_are_used_once_and_may_differ() -> None:
    env = MultiGoalVecEnv(2, seed=0)
    env.set_options([{"position": (1.0, 2.0)}, {"position": (3.0, 4.0)}])
    np.testing.assert_array_equal(env.reset(), [[1, 2, 0, 0], [3, 4, 0, 0]])
    assert not np.isin(env.reset()[:, :2], [1, 2, 3, 4]).any()


@pytest.mark.parametrize(
    "second", [{}, {"velocity": (1.0, 1.0)}, {"position": (0.0, 0.0), "velocity": (1.0, 1.0)}]
)
def test_options_that_are_not_alike_are_refused(second: dict[str, Any]) -> None:
    for options in ([{"position": (1.0, 2.0)}, second], [second, {"position": (1.0, 2.0)}]):
        env = MultiGoalVecEnv(2, seed=0)
        env.set_options(options)
        with pytest.raises(ValueError, match="same keys for all environments, not"):
            env.reset()


def test_state_round_trip_repeats_the_future() -> None:
    env = MultiGoalVecEnv(8, seed=0)
    env.reset()
    actions = random_actions(8, 100)
    for action in actions[:30]:
        env.step(action)
    state = env.get_state()
    future = [env.step(action)[0] for action in actions]
    other = MultiGoalVecEnv(8, seed=9)
    other.reset()
    other.set_state(state)
    np.testing.assert_array_equal(future, [other.step(action)[0] for action in actions])


@pytest.mark.slow
def test_ppo_trains_on_it_under_vec_monitor() -> None:
    env = VecMonitor(MultiGoalVecEnv(64, seed=0))
    model = PPO("MlpPolicy", env, n_steps=60, batch_size=960, n_epochs=1, seed=0, device="cpu")
    model.learn(2 * 60 * 64)
    assert model.num_timesteps == 2 * 60 * 64
    assert len(model.ep_info_buffer) == 100
    assert max(episode["l"] for episode in model.ep_info_buffer) == 50
    assert len(model.ep_success_buffer) == 100


# What Gymnasium asks for, and pictures


def test_gymnasium_makes_both_forms() -> None:
    env = gym.make("MultiGoal-v0")
    assert isinstance(env.unwrapped, MultiGoalEnv)
    assert env.spec.max_episode_steps == 50
    vector = gym.make_vec("MultiGoal-v0", num_envs=3)
    assert isinstance(vector, MultiGoalVectorEnv)
    assert vector.observation_space.shape == (3, 4)
    shorter = gym.make_vec("MultiGoal-v0", num_envs=1, max_episode_steps=7)
    shorter.reset(options={"position": (0.0, 0.0)})
    assert [bool(shorter.step(STILL[None])[3][0]) for _ in range(7)] == [False] * 6 + [True]


def test_each_environment_seeds_its_own_spaces() -> None:
    one, other = MultiGoalEnv(), MultiGoalEnv()
    one.action_space.seed(0)
    first = one.action_space.sample()
    one.action_space.seed(0)
    other.action_space.sample()
    np.testing.assert_array_equal(one.action_space.sample(), first)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_environment_checkers_pass() -> None:
    gymnasium_check_env(gym.make("MultiGoal-v0", render_mode="rgb_array").unwrapped)
    sb3_check_env(MultiGoalEnv())


def test_picture_shows_the_goals_the_walls_and_the_point() -> None:
    env = started(position=(0.0, 0.0), velocity=(0.0, 10.0), render_mode="rgb_array")
    for _ in range(5):
        env.step(STILL)
    frame = env.render()
    assert frame.shape == (FRAME_SIZE, FRAME_SIZE, 3)
    assert frame.dtype == np.uint8

    def at(point: ArrayLike) -> NDArray[np.float64]:
        column, row = Canvas(FRAME_SIZE, WALL * 1.06).pixel(point).round().astype(int)
        return frame[row, column] / 255

    for goal, color in zip(GOALS, GOAL_COLORS, strict=True):
        np.testing.assert_allclose(at(goal), color, atol=0.01)
    assert at((0.0, 5.0)).max() < 0.3, "the point, after five steps of length one"
    assert at((0.0, 2.5)).max() < at((2.5, 0.0)).min(), "its trail"
    assert at((-3.0, -0.0)).min() > 0.9


def test_the_trail_starts_anew_with_each_episode() -> None:
    env = started(position=(0.0, 0.0), velocity=(10.0, 0.0), render_mode="rgb_array")
    before = env.render()
    env.step(STILL)
    assert not np.array_equal(env.render(), before)
    env.reset(options={"position": (0.0, 0.0)})
    np.testing.assert_array_equal(env.render(), before)
