"""Where demonstrations come from: arrays, files, transitions, Minari, recordings, scripts."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize, VecTransposeImage

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.multigoal.point_masses import GOALS
from sb3_policyflow.imitation import (
    Demonstrations,
    clone,
    load_demonstrations,
    record_episodes,
    save_episodes,
)
from sb3_policyflow.imitation.demonstrators import (
    MULTI_GOAL_STYLES,
    MultiGoalDemonstrator,
    demonstrate,
    make_env,
)
from tests.helpers import SMALL, TINY, weights


@dataclass
class Trajectory:
    """As the library ``imitation`` has it: one observation more than actions."""

    obs: Any
    acts: np.ndarray
    rews: np.ndarray


def trajectories() -> list[Trajectory]:
    rng = np.random.default_rng(0)
    return [
        Trajectory(rng.standard_normal((n + 1, 3)), rng.uniform(-2, 2, (n, 1)), np.ones(n))
        for n in (5, 3)
    ]


def test_transitions() -> None:
    parts = trajectories()
    shown = load_demonstrations(parts)
    np.testing.assert_array_equal(shown.observations[:5], parts[0].obs[:5])
    np.testing.assert_array_equal(shown.observations[5:], parts[1].obs[:3])
    np.testing.assert_array_equal(shown.actions, np.concatenate([part.acts for part in parts]))
    assert shown.episodes is not None
    assert shown.episodes.tolist() == [0] * 5 + [1] * 3
    single = load_demonstrations(parts[0])
    assert single.episodes is None
    assert len(single.actions) == 5


def test_a_file(tmp_path: Path) -> None:
    shown = load_demonstrations(trajectories())
    shown.save(tmp_path / "shown.npz")
    again = load_demonstrations(tmp_path / "shown.npz")
    for name in ("observations", "actions", "episodes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(shown, name))
    observations = {"a": np.zeros((4, 2)), "b": np.ones((4, 3))}
    Demonstrations(observations, np.zeros((4, 1))).save(tmp_path / "dict.npz")
    loaded = load_demonstrations(str(tmp_path / "dict.npz"))
    assert loaded.observations.keys() == observations.keys()
    np.testing.assert_array_equal(loaded.observations["b"], observations["b"])


def test_a_file_of_an_earlier_version_had_returns(tmp_path: Path) -> None:
    arrays = {"observations": np.ones((4, 2)), "actions": np.zeros((4, 1))}
    np.savez(tmp_path / "old.npz", **arrays, episodes=np.arange(4), returns=np.ones(4))
    shown = load_demonstrations(tmp_path / "old.npz")
    np.testing.assert_array_equal(shown.observations, arrays["observations"])
    assert shown.episodes is not None
    assert shown.episodes.tolist() == [0, 1, 2, 3]


def test_a_file_of_something_else(tmp_path: Path) -> None:
    np.savez(tmp_path / "rollout.npz", observations=np.ones((4, 2)), rewards=np.ones(4))
    with pytest.raises(ValueError, match=r"has the arrays \['observations', 'rewards'\]"):
        load_demonstrations(tmp_path / "rollout.npz")


@pytest.mark.parametrize(
    "episodes",
    [
        np.arange(100),
        np.arange(400),
        np.zeros((300, 1), dtype=int),
        np.zeros(300),
        np.zeros(300, dtype=bool),
    ],
    ids=["too few", "too many", "a column", "floats", "booleans"],
)
def test_episodes_that_do_not_belong_to_the_transitions(episodes: np.ndarray) -> None:
    demonstrations = Demonstrations(np.zeros((300, 3)), np.zeros((300, 1)), episodes)
    with pytest.raises(ValueError, match="episodes of demonstrations must be 300 integers"):
        load_demonstrations(demonstrations)


def test_episodes_may_be_a_list_of_any_numbers() -> None:
    shown = load_demonstrations(Demonstrations(np.zeros((3, 3)), np.zeros((3, 1)), [7, 7, -1]))  # type: ignore[arg-type]
    assert shown.episodes is not None
    assert shown.episodes.tolist() == [7, 7, -1]


@pytest.mark.parametrize(
    ("source", "what"),
    [
        ("missing.npz", r"no demonstrations at missing.npz: give an .npz file, or 'minari:"),
        (3, r"a pair of arrays, got int"),
        ([1, 2], r"a pair of arrays, got list"),
    ],
)
def test_what_is_nothing_of_this(source: Any, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        load_demonstrations(source)


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_a_recording(algorithm: type[Any]) -> None:
    env = make_vec_env("Pendulum-v1", n_envs=3, seed=0)
    model = algorithm("MlpPolicy", env, seed=0)
    episodes = record_episodes(model, n_episodes=4, deterministic=True)
    assert [len(episode.acts) for episode in episodes] == [200] * 4
    assert not any(episode.terminal for episode in episodes)
    for episode in episodes:
        np.testing.assert_allclose(
            model.predict(episode.obs[:-1], deterministic=True)[0], episode.acts, atol=1e-5
        )
        # The pendulum's angular speed follows from its angle, its speed and the torque.
        sine, speed = episode.obs[:-1, 1], episode.obs[:-1, 2]
        following = speed + 0.05 * (15 * sine + 3 * episode.acts[:, 0])
        np.testing.assert_allclose(episode.obs[1:, 2], following.clip(-8, 8), atol=1e-3)


def test_observations_are_recorded_before_they_are_normalized() -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0))
    model = PPO("MlpPolicy", env, n_steps=64, seed=0).learn(128)
    count = env.obs_rms.count  # type: ignore[union-attr]
    episode = record_episodes(model, n_episodes=1, deterministic=True)[0]
    assert np.abs(np.linalg.norm(episode.obs[:, :2], axis=1) - 1).max() < 1e-5  # cosine and sine
    normalized = env.normalize_obs(episode.obs[:-1])
    acts = model.predict(normalized, deterministic=True)[0]
    np.testing.assert_allclose(acts, episode.acts, atol=1e-5)
    assert env.obs_rms.count == count  # type: ignore[union-attr]


def test_where_a_recording_is_not_possible() -> None:
    model = PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8)
    model.env = None
    with pytest.raises(ValueError, match="no environment to be recorded in"):
        record_episodes(model)
    image = gym.make("Pendulum-v1")
    image.observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    wrapped = VecTransposeImage(VecNormalize(make_vec_env(lambda: image), norm_obs=False))
    with pytest.raises(ValueError, match="VecTransposeImage wraps the VecNormalize"):
        record_episodes(model, wrapped)


def test_a_clone_of_a_recording_acts_as_the_model_did() -> None:
    env = make_vec_env("Pendulum-v1", n_envs=4, seed=0)
    model = PPO("MlpPolicy", env, seed=1, policy_kwargs={"log_std_init": -3.0})
    with th.no_grad():
        model.policy.action_net.weight.mul_(50)
    episodes = record_episodes(model, n_episodes=8, deterministic=True)
    cloned = PolicyFlow("MlpPolicy", env, policy_kwargs=TINY, **SMALL)
    clone(cloned, episodes, gradient_steps=300, batch_size=256, learning_rate="lin_0.01")
    shown = load_demonstrations(episodes)
    error = cloned.predict(shown.observations, deterministic=True)[0] - shown.actions
    assert error.std() < 0.3 * shown.actions.std()


# Scripted demonstrators


@pytest.mark.parametrize(
    ("style", "lowest", "highest"),
    [("good", 8.8, 9.1), ("slow", 7.1, 8.0), ("noisy", 8.5, 8.9)],
)
def test_multi_goal(style: str, lowest: float, highest: float) -> None:
    episodes = demonstrate("MultiGoal-v0", style, n_episodes=512)
    returns = [episode.rews.sum() for episode in episodes]
    assert len(episodes) == 512
    assert lowest < np.mean(returns) < highest
    ends = np.stack([episode.obs[-1][:2] for episode in episodes])
    distances = np.linalg.norm(ends[:, None] - GOALS, axis=-1)
    assert set(distances.argmin(axis=1)) == set(range(6))
    assert (distances.min(axis=1) < 1.0).mean() > 0.95
    largest = max(np.abs(episode.acts).max() for episode in episodes)
    assert largest <= (1.0 if style == "slow" else 5.0)


def test_from_the_center_all_goals_are_alike() -> None:
    act = MultiGoalDemonstrator(MULTI_GOAL_STYLES["good"], seed=0)
    actions = act(np.zeros((6000, 4)), np.ones(6000, dtype=bool))
    counts = np.bincount((actions @ GOALS.T).argmax(axis=1), minlength=6)
    assert counts.min() > 880
    assert counts.max() < 1120


@pytest.mark.slow
def test_point_maze() -> None:
    pytest.importorskip("gymnasium_robotics")
    episodes = demonstrate("PointMazeMultiGoal-Medium-v0", n_episodes=24)
    goals = make_env("PointMazeMultiGoal-Medium-v0", 1, 0).get_attr("unwrapped")[0].goals
    ends = np.stack([episode.obs[-1][:2] for episode in episodes])
    distances = np.linalg.norm(ends[:, None] - goals, axis=-1)
    assert set(distances.argmin(axis=1)) == set(range(4))
    assert distances.min(axis=1).max() < 0.45
    assert min(episode.rews.sum() for episode in episodes) > 300


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("CartPole-v1",), "env must be one of 'MultiGoal-v0', 'PointMaze"),
        (("MultiGoal-v0", "bad"), "style must be one of 'good', 'slow', 'noisy'"),
        (("MultiGoal-v0", "good", 0), "n_episodes must be at least 1"),
    ],
)
def test_demonstrators_that_do_not_exist(arguments: Any, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        demonstrate(*arguments)


def test_a_place_for_episodes_that_is_none() -> None:
    with pytest.raises(ValueError, match=r"Give 'minari:DATASET' or a path that ends in '.npz'"):
        save_episodes([], "demonstrations.csv", make_env("MultiGoal-v0", 1, 0))


def test_cloned_from_a_file_or_from_memory(tmp_path: Path) -> None:
    episodes = demonstrate("MultiGoal-v0", n_episodes=16)
    save_episodes(episodes, tmp_path / "shown.npz", make_env("MultiGoal-v0", 1, 0))
    models = [
        clone(PolicyFlow("MlpPolicy", "MultiGoal-v0", policy_kwargs=TINY, **SMALL), source,
              gradient_steps=5)
        for source in (episodes, tmp_path / "shown.npz")
    ]  # fmt: skip
    assert th.equal(*map(weights, models))


# Minari


@pytest.fixture
def minari_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


@pytest.mark.usefixtures("minari_folder")
def test_minari_keeps_episodes() -> None:
    import minari

    episodes = demonstrate("MultiGoal-v0", n_episodes=4)
    env = make_env("MultiGoal-v0", 1, 0)
    save_episodes(episodes, "minari:tests/multigoal-v0", env, "MultiGoal-v0")
    dataset = minari.load_dataset("tests/multigoal-v0")
    assert dataset.total_episodes == 4
    direct = load_demonstrations(episodes)
    for source in ("minari:tests/multigoal-v0", dataset):
        shown = load_demonstrations(source)
        np.testing.assert_array_equal(shown.observations, direct.observations)
        np.testing.assert_array_equal(shown.actions, direct.actions)
        np.testing.assert_array_equal(shown.episodes, direct.episodes)
        assert shown.action_space == env.action_space
    assert dataset.recover_environment().spec.id == "MultiGoal-v0"
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, **SMALL)
    with pytest.raises(ValueError, match=r"are Box\(-inf.*the model's are Box\(\[-1"):
        clone(model, "minari:tests/multigoal-v0")


@pytest.mark.usefixtures("minari_folder")
def test_minari_with_dictionaries() -> None:
    import minari
    from minari.data_collector import EpisodeBuffer

    space = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Box(-1, 1, (3,))})
    buffer = EpisodeBuffer(
        observations={"a": np.zeros((5, 2), np.float32), "b": np.ones((5, 3), np.float32)},
        actions=np.zeros((4, 1), np.float32),
        rewards=[1.0] * 4,
        terminations=[False] * 4,
        truncations=[False] * 3 + [True],
    )
    minari.create_dataset_from_buffers(
        "tests/dict-v0", [buffer], observation_space=space, action_space=spaces.Box(-1, 1, (1,))
    )
    shown = load_demonstrations("minari:tests/dict-v0")
    assert {key: part.shape for key, part in shown.observations.items()} == {
        "a": (4, 2),
        "b": (4, 3),
    }


def test_without_minari_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"Minari: pip install .*minari"):
        load_demonstrations("minari:D4RL/door/human-v2")
