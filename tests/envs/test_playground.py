"""MuJoCo Playground's tasks against the engine itself. `make test-playground` runs these."""

import os
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import sb3_policyflow
from sb3_policyflow.envs import PLAYGROUND_TASKS, ensure_registered
from sb3_policyflow.envs.playground import PlaygroundVecEnv, PlaygroundVectorEnv
from sb3_policyflow.envs.vector import GymVectorVecEnv

pytest.importorskip("mujoco_playground", reason="playground is not installed")

import jax
from mujoco_playground import registry

pytestmark = pytest.mark.slow

N_ENVS, LIMIT = 4, 5
CARTPOLE = "CartpoleBalance"


def engine(task: str) -> Any:
    return registry.load(task, config_overrides={"impl": "jax"})


def row(tree: Any, index: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def draw_actions(env: Any, n_steps: int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(-1, 1, (n_steps, *env.action_space.shape))


@pytest.fixture(scope="module")
def cartpoles() -> PlaygroundVectorEnv:
    """One small batch with short episodes for many tests: each compilation takes seconds."""
    return PlaygroundVectorEnv(CARTPOLE, N_ENVS, max_episode_steps=LIMIT)


@pytest.fixture(scope="module")
def engine_step() -> Any:
    return jax.jit(engine(CARTPOLE).step)


@pytest.mark.parametrize("task", PLAYGROUND_TASKS)
def test_steps_as_the_engine_does(task: str) -> None:
    """From each state that is passed through: small differences of contacts would add up."""
    env = gym.make_vec(f"Playground/{task}-v0", 2)
    theirs = engine(task)
    step = jax.jit(theirs.step)
    assert env.batch.max_episode_steps == registry.get_default_config(task).episode_length == 1000
    limits = theirs.mj_model.actuator_ctrlrange
    np.testing.assert_array_equal(env.single_action_space.low, limits[:, 0])
    np.testing.assert_array_equal(env.single_action_space.high, limits[:, 1])
    observations, _ = env.reset(seed=3)
    assert observations.shape == (2, theirs.observation_size)
    for action in draw_actions(env, 30).astype(np.float32):
        before = env.batch.state
        observations, rewards, terminated, truncated, _ = env.step(action)
        assert not terminated.any()
        assert not truncated.any()
        for i in range(2):
            expected = step(row(before, i), action[i])
            np.testing.assert_allclose(observations[i], expected.obs, rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(rewards[i], expected.reward, rtol=1e-4, atol=1e-5)


def test_the_limit_truncates_and_resets_at_its_step(
    cartpoles: PlaygroundVectorEnv, engine_step: Any
) -> None:
    first, _ = cartpoles.reset(seed=0)
    actions = draw_actions(cartpoles, LIMIT).astype(np.float32)
    for action in actions[:-1]:
        _, _, terminated, truncated, infos = cartpoles.step(action)
        assert not (terminated | truncated).any()
        assert infos == {}
    before = cartpoles.batch.state
    observations, rewards, terminated, truncated, infos = cartpoles.step(actions[-1])
    assert truncated.all()
    assert not terminated.any()
    assert infos["_final_obs"].all()
    for i in range(N_ENVS):
        expected = engine_step(row(before, i), actions[-1][i])
        np.testing.assert_allclose(infos["final_obs"][i], expected.obs, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(rewards[i], expected.reward, rtol=1e-5)
    # The start of the balancing task: near the middle, upright, and not where it was.
    assert np.abs(observations[:, 0]).max() < 0.1
    assert np.abs(observations[:, 2]).max() < np.sin(0.035)
    assert np.abs(observations - first).max(axis=1).min() > 1e-4
    assert not cartpoles.step(actions[0])[3].any(), "the clock starts anew"


def starts(env: Any, seed: int, n_episodes: int) -> NDArray[np.float32]:
    """Observations that episodes start with, shape (n_episodes, num_envs, obs_dim)."""
    found = [env.reset(seed=seed)[0]]
    for action in draw_actions(env, LIMIT * (n_episodes - 1)):
        observations, _, _, truncated, _ = env.step(action)
        if truncated.any():
            found.append(observations)
    return np.array(found)


def test_each_episode_starts_in_a_state_of_its_own(cartpoles: PlaygroundVectorEnv) -> None:
    found = starts(cartpoles, 0, 6)
    assert found.shape == (6, N_ENVS, 5)
    assert len(np.unique(found.reshape(-1, 5), axis=0)) == 6 * N_ENVS


def test_a_seed_repeats_and_another_differs(cartpoles: PlaygroundVectorEnv) -> None:
    once, again, other = starts(cartpoles, 7, 3), starts(cartpoles, 7, 3), starts(cartpoles, 8, 3)
    np.testing.assert_array_equal(once, again)
    assert (once != other).any(axis=-1).all()
    unseeded = [cartpoles.reset()[0] for _ in range(2)]
    assert (unseeded[0] != unseeded[1]).any()


def ends(env: Any, n_steps: int) -> list[list[int]]:
    """The steps, from 1, at which each environment's episodes end."""
    dones = [env.step(np.zeros((N_ENVS, 1)))[2] for _ in range(n_steps)]
    return [(np.flatnonzero(column) + 1).tolist() for column in np.array(dones).T]


def test_first_episodes_end_at_random_steps_if_asked(cartpoles: PlaygroundVectorEnv) -> None:
    env = VecNormalize(VecMonitor(GymVectorVecEnv(cartpoles)))
    found = []
    for seed in (0, 1, 2, 3, 4, 0):
        env.seed(seed)
        env.set_options({"init_at_random_ep_len": True})
        env.reset()
        found.append(ends(env, 2 * LIMIT))
    assert found[0] == found[-1] != found[1]
    pairs = [(first, second) for episodes in found for first, second, *_ in episodes]
    assert {first for first, _ in pairs} == set(range(1, LIMIT + 1))
    assert all(second == first + LIMIT for first, second in pairs)
    env.reset()  # options are for one reset
    assert ends(env, 2 * LIMIT) == [[LIMIT, 2 * LIMIT]] * N_ENVS


def test_a_broken_simulation_ends_that_episode_only(
    cartpoles: PlaygroundVectorEnv, engine_step: Any
) -> None:
    cartpoles.reset(seed=0)
    actions = draw_actions(cartpoles, 2 + LIMIT).astype(np.float32)
    cartpoles.step(actions[0])
    broken = actions[1].copy()
    broken[2] = np.nan
    before = cartpoles.batch.state
    observations, rewards, terminated, truncated, infos = cartpoles.step(broken)
    np.testing.assert_array_equal(terminated, [False, False, True, False])
    np.testing.assert_array_equal(infos["_final_obs"], terminated)
    assert not truncated.any()
    assert np.isnan(infos["final_obs"][2]).any()
    assert rewards[2] == 0
    assert np.isfinite(observations).all()
    assert np.isfinite(rewards).all()
    expected = engine_step(row(before, 0), broken[0]).obs
    np.testing.assert_allclose(observations[0], expected, rtol=1e-5, atol=1e-6)
    ends = np.array([cartpoles.step(action)[3] for action in actions[2:]])
    # Two of five steps had been taken; the new episode takes five.
    assert np.argmax(ends, axis=0).tolist() == [2, 2, 4, 2]
    assert ends.sum(axis=0).tolist() == [1, 1, 1, 1]


def test_sb3_sees_the_ends_of_episodes(cartpoles: PlaygroundVectorEnv) -> None:
    cartpoles.reset(seed=0)
    env = VecMonitor(GymVectorVecEnv(cartpoles))
    env.reset()
    actions = draw_actions(cartpoles, LIMIT).astype(np.float32)
    actions[0, 1] = np.nan
    steps = [env.step(action) for action in actions]
    assert steps[0][2].tolist() == [False, True, False, False]
    assert steps[0][3][1]["TimeLimit.truncated"] is False
    assert steps[0][3][1]["episode"]["l"] == 1
    assert steps[-1][2].tolist() == [True, False, True, True]
    assert steps[-1][3][0]["TimeLimit.truncated"] is True
    assert steps[-1][3][0]["terminal_observation"].shape == (5,)
    total = sum(rewards[0] for _, rewards, _, _ in steps)
    assert steps[-1][3][0]["episode"]["r"] == pytest.approx(total, rel=1e-5)
    assert steps[-1][3][0]["episode"]["l"] == LIMIT


def test_a_step_is_traced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = PlaygroundVectorEnv("PendulumSwingup", 2, max_episode_steps=3)
    traced = []
    original = env.batch.env.step
    monkeypatch.setattr(env.batch.env, "step", lambda *args: traced.append(1) or original(*args))
    env.reset(seed=0)
    env.step(np.zeros((2, 1)))
    n_traced = len(traced)
    assert n_traced > 0
    for action in draw_actions(env, 7):
        env.step(action)
    env.reset()
    env.step(np.zeros((2, 1), np.float64))
    assert len(traced) == n_traced


def test_policyflow_learns_with_normalization(cartpoles: PlaygroundVectorEnv) -> None:
    env = VecNormalize(VecMonitor(GymVectorVecEnv(cartpoles)))
    model = sb3_policyflow.PolicyFlow("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=2)
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(2 * 16 * N_ENVS)
    assert model.num_timesteps == 2 * 16 * N_ENVS
    assert any(
        (old != new).any() for old, new in zip(before, model.policy.parameters(), strict=True)
    )
    assert len(model.ep_info_buffer) == 2 * 16 // LIMIT * N_ENVS
    assert env.obs_rms.count > 0
    assert np.isfinite(env.obs_rms.mean).all()


def test_tensors_share_memory_and_equal_arrays(cartpoles: PlaygroundVectorEnv) -> None:
    actions = draw_actions(cartpoles, 2 * LIMIT).astype(np.float32)
    first, _ = cartpoles.reset(seed=4)
    arrays = [cartpoles.step(action) for action in actions]
    np.testing.assert_array_equal(cartpoles.reset_tensors(seed=4).numpy(), first)
    for action, (observations, rewards, terminated, truncated, infos) in zip(
        actions, arrays, strict=True
    ):
        step = cartpoles.step_tensors(th.from_numpy(action))
        np.testing.assert_array_equal(step.observations, observations)
        np.testing.assert_array_equal(step.rewards, rewards)
        np.testing.assert_array_equal(step.terminated, terminated)
        np.testing.assert_array_equal(step.truncated, truncated)
        final = np.stack(infos["final_obs"]) if truncated.any() else observations
        np.testing.assert_array_equal(step.final_observations, final)
        device_array = cartpoles.batch.state.obs
        assert step.observations.data_ptr() == device_array.unsafe_buffer_pointer()


@pytest.mark.filterwarnings("ignore:.*not within the observation space|.*gym.make.*")
def test_check_env() -> None:
    env = gym.make(f"Playground/{CARTPOLE}-v0", max_episode_steps=20)
    sb3_check_env(env)
    gymnasium_check_env(env.unwrapped, skip_render_check=True)
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(first, again)
    observation, reward, terminated, truncated, _ = env.step(np.zeros(1))
    assert observation.shape == (5,)
    assert type(reward) is float
    assert (type(terminated), type(truncated)) == (bool, bool)


def test_bad_input_is_refused(cartpoles: PlaygroundVectorEnv) -> None:
    with pytest.raises(ValueError, match=r"actions of shape \(4, 1\), not \(4,\)"):
        cartpoles.step(np.zeros(N_ENVS))
    with pytest.raises(ValueError, match="takes no options"):
        cartpoles.reset(options={"position": 1})
    with pytest.raises(ValueError, match="init_at_random_ep_len must be True or False, got 3"):
        cartpoles.reset(options={"init_at_random_ep_len": 3})
    with pytest.raises(gym.error.NameNotFound, match="no task 'CheetaRun'; nearest: CheetahRun"):
        PlaygroundVecEnv("CheetaRun", 2)
    with pytest.raises(gym.error.NameNotFound, match="nearest: CheetahRun"):
        ensure_registered("Playground/CheetahRun-v9")

    with pytest.raises(ValueError, match="must be at least 1, not 2 and 0"):
        PlaygroundVecEnv(CARTPOLE, 2, max_episode_steps=0)
    with pytest.raises(gym.error.ResetNeeded, match="Call reset"):
        PlaygroundVectorEnv(CARTPOLE, 2).step(np.zeros((2, 1)))


DRAW = """
import gymnasium as gym, numpy as np, sb3_policyflow
env = gym.make("Playground/CartpoleBalance-v0", render_mode="rgb_array")
env.reset(seed=0)
first = env.render()
for _ in range(30):
    env.step(np.ones(1, np.float32))
frame = env.render()
assert frame.shape == (240, 320, 3) and frame.dtype == np.uint8 and frame.std() > 5
assert (frame != first).mean() > 0.001
"""


@pytest.mark.parametrize("backend", ["egl", "glfw"])
def test_pictures_or_one_sentence(backend: str) -> None:
    """Without a display, which glfw needs and egl does not."""
    variables = {key: value for key, value in os.environ.items() if not key.endswith("DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-c", DRAW],
        capture_output=True,
        text=True,
        check=False,
        env={**variables, "MUJOCO_GL": backend},
    )
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1]
        assert last.startswith("gymnasium.error.DependencyNotInstalled: MuJoCo cannot draw here")
        assert "MUJOCO_GL=egl" in last
        if backend == "egl":
            pytest.skip(last)
