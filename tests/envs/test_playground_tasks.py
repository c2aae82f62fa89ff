"""Settings of MuJoCo Playground's tasks, and tasks that users add. `make test-playground`."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sb3_policyflow
from sb3_policyflow.envs import ensure_registered
from sb3_policyflow.envs.playground import PlaygroundEnv, PlaygroundVecEnv, PlaygroundVectorEnv

pytest.importorskip("mujoco_playground", reason="playground is not installed")

import jax
import jax.numpy
from mujoco_playground import dm_control_suite
from mujoco_playground._src.dm_control_suite import cartpole
from mujoco_playground._src.mjx_env import MENAGERIE_PATH

from sb3_policyflow.envs.playground.batch import all_tasks, task_config

pytestmark = pytest.mark.slow

STOCK_TASKS = all_tasks()
"""Before tests add more."""
ROBOT = "Go1JoystickFlatTerrain"


def test_the_task_settings_can_be_changed() -> None:
    env = PlaygroundEnv(
        "CartpoleBalance", config_overrides={"action_repeat": 2, "episode_length": 6}
    )
    plain = PlaygroundEnv("CartpoleBalance")
    np.testing.assert_array_equal(env.reset(seed=0)[0], plain.reset(seed=0)[0])
    for step in range(3):
        action = np.array([0.3 * step], np.float32)
        observation, reward, _, truncated, _ = env.step(action)
        *_, first_reward, _, _, _ = plain.step(action)
        expected, second_reward, _, _, _ = plain.step(action)
        np.testing.assert_allclose(observation, expected, rtol=1e-4, atol=1e-5)
        assert reward == pytest.approx(first_reward + second_reward, rel=1e-5)
        assert truncated == (step == 2)
    with pytest.raises(ValueError, match=r"no setting 'sim_td'.*: it has .*sim_dt"):
        PlaygroundEnv("CartpoleBalance", config_overrides={"sim_td": 0.1})


@pytest.mark.parametrize(
    "overrides",
    [
        {"reward_config.scales.tracking_lin_vel": 9.0},
        {"reward_config": {"scales": {"tracking_lin_vel": 9.0}}},
    ],
)
def test_settings_within_settings_can_be_changed(overrides: dict[str, Any]) -> None:
    before = task_config(ROBOT, {}).to_dict()
    after = task_config(ROBOT, overrides).to_dict()
    before["reward_config"]["scales"]["tracking_lin_vel"] = 9.0
    assert after == before


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"reward_config.scales.speed": 1}, "reward_config.scales has .*tracking_lin_vel"),
        (
            {"reward_config": {"scalse": {"speed": 1}}},
            "'reward_config.scalse.speed'.*reward_config",
        ),
        ({"sim_dt.speed": 1}, "sim_dt has no settings in it"),
    ],
)
def test_settings_that_there_are_not_are_refused(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task_config(ROBOT, overrides)


class EndsAtOnce(cartpole.Balance):
    """A task whose episodes end with their first step, which pays 1, as each later one would."""

    def step(self, state: Any, action: Any) -> Any:
        after = super().step(state, action)
        return after.replace(reward=jax.numpy.ones(()), done=jax.numpy.ones(()))


def test_a_task_that_ends_within_repeated_actions_stops_there() -> None:
    def make(**kwargs: Any) -> Any:
        return EndsAtOnce(swing_up=False, sparse=False, **kwargs)

    dm_control_suite.register_environment("EndsAtOnce", make, cartpole.default_config)
    once = PlaygroundVectorEnv("EndsAtOnce", 2)
    thrice = PlaygroundVectorEnv("EndsAtOnce", 2, config_overrides={"action_repeat": 3})
    for env in (once, thrice):
        env.reset(seed=0)
    expected, found = (env.step(np.ones((2, 1))) for env in (once, thrice))
    assert found[1].tolist() == [1.0, 1.0]
    assert found[2].all()
    for theirs, ours in zip(expected[4]["final_obs"], found[4]["final_obs"], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_a_file_that_a_users_task_lacks_is_not_blamed_on_the_robots() -> None:
    def make(**kwargs: Any) -> Any:
        raise FileNotFoundError(2, "No such file", "my_robot.xml")

    dm_control_suite.register_environment("NoFile", make, cartpole.default_config)
    with pytest.raises(FileNotFoundError, match=r"my_robot\.xml"):
        PlaygroundEnv("NoFile")


@pytest.mark.skipif(MENAGERIE_PATH.exists(), reason="mujoco_menagerie is there")
def test_robots_that_cannot_be_fetched_are_named_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", "")  # so that there is no git
    with pytest.raises(gym.error.DependencyNotInstalled, match="needs the robots of mujoco_menag"):
        PlaygroundEnv(ROBOT)


def test_every_other_task_is_registered() -> None:
    assert {f"Playground/{task}-v0" for task in STOCK_TASKS} <= set(gym.registry)
    assert gym.make("Playground/PendulumSwingup-v0").observation_space.shape == (3,)


def test_a_task_that_was_added_is_registered_on_request() -> None:
    def make(**kwargs: Any) -> Any:
        return cartpole.Balance(swing_up=False, sparse=False, **kwargs)

    dm_control_suite.register_environment("Added", make, cartpole.default_config)
    for _ in range(2):
        ensure_registered("Playground/Added-v0")
    assert gym.make("Playground/Added-v0").observation_space.shape == (5,)


class TwoSenses(cartpole.Balance):
    """A task as a user may add it: what it observes is a dictionary."""

    def _get_obs(self, data: Any, info: Any) -> dict[str, Any]:
        everything = super()._get_obs(data, info)
        return {"state": everything[:3], "velocity": everything[3:]}


def test_a_task_of_the_users_own_with_several_observations() -> None:
    def make(**kwargs: Any) -> Any:
        return TwoSenses(swing_up=False, sparse=False, **kwargs)

    dm_control_suite.register_environment("TwoSenses", make, cartpole.default_config)
    env = PlaygroundVecEnv("TwoSenses", 2, seed=0, max_episode_steps=3)
    assert set(env.observation_space.spaces) == {"state", "velocity"}
    first = env.reset()
    assert (first["state"].shape, first["velocity"].shape) == ((2, 3), (2, 2))
    *_, infos = [env.step(np.zeros((2, 1))) for _ in range(3)][-1]
    assert infos[1]["terminal_observation"]["state"].shape == (3,)
    model = sb3_policyflow.PolicyFlow("MultiInputPolicy", env, n_steps=4, batch_size=8, n_epochs=1)
    assert model.learn(16).num_timesteps == 16
