"""Gymnasium's vector environments as SB3 sees them through the adapter."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList
from stable_baselines3.common.vec_env import DummyVecEnv, VecVideoRecorder

from sb3_policyflow.envs.multigoal import MultiGoalEnv, MultiGoalVecEnv, MultiGoalVectorEnv
from sb3_policyflow.envs.multigoal.point_masses import FRAME_SIZE
from sb3_policyflow.envs.vector import GymVectorVecEnv, final_infos, unbatch_infos


def cart_poles(n: int, mode: AutoresetMode = AutoresetMode.SAME_STEP) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n, autoreset_mode=mode)


def test_adapter_equals_dummy_vec_env_on_cart_pole() -> None:
    ours, dummy = GymVectorVecEnv(cart_poles(3)), DummyVecEnv([lambda: gym.make("CartPole-v1")] * 3)
    ours.seed(5)
    dummy.seed(5)
    np.testing.assert_array_equal(ours.reset(), dummy.reset())
    rng = np.random.default_rng(0)
    n_ends = 0
    for _ in range(100):
        actions = rng.integers(2, size=3)
        got, expected = ours.step(actions), dummy.step(actions)
        for one, other in zip(got[:3], expected[:3], strict=True):
            np.testing.assert_array_equal(one, other)
        for one, other in zip(got[3], expected[3], strict=True):
            assert one.keys() == other.keys()
            np.testing.assert_array_equal(
                one.get("terminal_observation", 0), other.get("terminal_observation", 0)
            )
        n_ends += got[2].sum()
    assert n_ends > 5


def test_adapter_reaches_sub_environments() -> None:
    env = GymVectorVecEnv(cart_poles(2))
    env.set_attr("marker", 7, indices=1)
    assert env.get_attr("marker", indices=1) == [7]
    assert not env.has_attr("marker")
    assert env.env_method("get_wrapper_attr", "marker", indices=[1]) == [7]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [True, True]


def test_adapter_acts_on_a_native_batch_as_a_whole() -> None:
    env = MultiGoalVecEnv(3, render_mode="rgb_array")
    assert env.get_attr("render_mode") == ["rgb_array"] * 3
    assert env.get_attr("action_space", indices=0)[0].shape == (2,)
    env.set_attr("marker", 1)
    assert env.get_attr("marker", indices=[0, 2]) == [1, 1]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 3
    with pytest.raises(ValueError, match="as one batch"):
        env.set_attr("marker", 1, indices=0)
    with pytest.raises(ValueError, match="as one batch"):
        env.env_method("get_state", indices=[1])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_adapter_refuses_other_autoreset_modes(mode: AutoresetMode) -> None:
    with pytest.raises(ValueError, match="SAME_STEP"):
        GymVectorVecEnv(cart_poles(1, mode))


def test_adapter_refuses_options_it_cannot_batch() -> None:
    env = GymVectorVecEnv(cart_poles(2))
    env.set_options([{"low": 0.0}, {"low": -0.1}])
    with pytest.raises(ValueError, match="one dictionary"):
        env.reset()


def test_vec_env_tiles_its_pictures() -> None:
    env = MultiGoalVecEnv(4, seed=0, render_mode="rgb_array")
    env.reset()
    assert env.render().shape == (2 * FRAME_SIZE, 2 * FRAME_SIZE, 3)


def test_videos_have_the_speed_of_the_environment(tmp_path: Path) -> None:
    env = MultiGoalVecEnv(2, seed=0, render_mode="rgb_array")
    recorder = VecVideoRecorder(env, str(tmp_path), lambda step: False)
    assert recorder.frames_per_sec == MultiGoalEnv.metadata["render_fps"] != 30
    # SB3's own, which shows pictures with OpenCV.
    assert env.metadata["render_modes"] == ["human", "rgb_array"]


def test_infos_are_not_shared_between_environments() -> None:
    env = MultiGoalVecEnv(2, seed=0)
    env.reset()
    *_, infos = env.step(np.zeros((2, 2)))
    infos[0]["mine"] = 1
    assert "mine" not in infos[1]
    assert "mine" not in env.step(np.zeros((2, 2)))[-1][0]


def test_infos_are_those_of_gymnasiums_wrapper() -> None:
    """Up to their types: the wrapper leaves NumPy's numbers."""
    ours, theirs = MultiGoalVectorEnv(64), DictInfoToList(MultiGoalVectorEnv(64))
    ours.reset(seed=0)
    theirs.reset(seed=0)
    n_ends = 0
    for actions in np.full((60, 64, 2), 3.0):
        infos = unbatch_infos(ours.step(actions)[-1], 64)
        for one, other in zip(infos, theirs.step(actions)[-1], strict=True):
            np.testing.assert_equal(one, other)
        n_ends += sum(info != {} for info in infos)
    assert n_ends > 64


def test_final_observations_may_be_dictionaries() -> None:
    observations = {"state": np.arange(6.0).reshape(3, 2), "goal": np.zeros((3, 1))}
    infos = final_infos(observations, np.array([False, True, False]))
    rows = unbatch_infos(infos, 3)
    assert rows[0] == rows[2] == {}
    assert rows[1]["final_obs"]["state"].tolist() == [2.0, 3.0]
    assert rows[1]["final_obs"]["goal"].tolist() == [0.0]
