"""SB3's contract for callbacks, logs and normalization; the tests have the names of SB3's own."""

import json
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformReward
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, sync_envs_normalization

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.vector import GymVectorVecEnv
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback
from tests.helpers import SMALL, TINY, n_updates, train, weights


def make(algorithm: type[Any], env: Any = "Pendulum-v1", **options: Any) -> Any:
    return algorithm("MlpPolicy", env, **{**SMALL, "policy_kwargs": TINY, **options})


# Callbacks


@pytest.mark.slow
def test_callbacks(algorithm: type[Any], tmp_path: Path) -> None:
    model = make(algorithm, IdentityEnvBox(-10, 10))
    evaluation = Monitor(IdentityEnvBox(-10, 10))
    no_progress = StopTrainingOnNoModelImprovement(1, min_evals=1)
    callbacks = CallbackList(
        [
            EvalCallback(
                evaluation,
                callback_after_eval=no_progress,
                best_model_save_path=str(tmp_path),
                log_path=str(tmp_path),
                eval_freq=50,
                warn=False,
            ),
            CheckpointCallback(save_freq=64, save_path=str(tmp_path)),
            RolloutCheckpointCallback(40, str(tmp_path), name_prefix="whole"),
            EveryNTimesteps(n_steps=64, callback=CheckpointCallback(1, str(tmp_path), "event")),
            StopTrainingOnMaxEpisodes(max_episodes=10**6),
        ]
    )
    model.learn(192, callback=callbacks)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"best_model.zip", "evaluations.npz", "rl_model_64_steps.zip"} <= names
    assert {"event_64_steps.zip", "whole_48_steps.zip", "whole_80_steps.zip"} <= names
    assert not [name for name in names if name.endswith(".tmp")]
    for name in names - {"evaluations.npz"}:
        assert algorithm.load(tmp_path / name).num_timesteps > 0
    model.learn(64, callback=None)
    model.learn(64, callback=lambda _locals, _globals: True)
    model.learn(64, callback=[StopTrainingOnMaxEpisodes(max_episodes=10**6)])


def test_callback_that_stops(algorithm: type[Any]) -> None:
    model = make(algorithm)
    model.learn(64, callback=lambda local_variables, _: local_variables["self"].num_timesteps < 20)
    assert model.num_timesteps == 20
    model.learn(16, reset_num_timesteps=False)
    assert model.num_timesteps == 36


def test_stop_on_reward_threshold() -> None:
    model = make(PolicyFlow, IdentityEnvBox(-10, 10))
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    evaluation = Monitor(IdentityEnvBox(-10, 10))
    model.learn(10_000, EvalCallback(evaluation, callback_on_new_best=stop, eval_freq=40))
    assert model.num_timesteps == 40


@pytest.mark.slow
def test_eval_callback_vec_env(algorithm: type[Any]) -> None:
    env = make_vec_env(lambda: IdentityEnvBox(-10, 10), 2)
    model = make(algorithm, IdentityEnvBox(-10, 10))
    callback = EvalCallback(env, eval_freq=32, warn=False)
    model.learn(64, callback=callback)
    assert callback.last_mean_reward > -np.inf


class Outcome(gym.Env[Any, Any]):
    """Episodes of five steps that say whether they succeeded."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        info = {"is_success": self.time == 5}
        return np.zeros(2, np.float32), 1.0, self.time == 5, False, info


def test_eval_success_logging(algorithm: type[Any], tmp_path: Path) -> None:
    model = make(algorithm, Outcome())
    model.set_logger(configure(str(tmp_path), ["json"]))
    callback = EvalCallback(Monitor(Outcome()), eval_freq=32, log_path=str(tmp_path), warn=False)
    model.learn(128, callback)
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    evaluations = [row for row in rows if "eval/mean_reward" in row]
    assert all(row["eval/success_rate"] == 1.0 for row in evaluations)
    # The evaluation is logged at the timestep at which it was made.
    assert [row["time/total_timesteps"] for row in evaluations] == [32, 64, 96, 128]
    assert any(row.get("rollout/success_rate") == 1.0 for row in rows)
    assert any(row.get("rollout/ep_rew_mean") == 5.0 for row in rows)
    np.testing.assert_array_equal(np.load(tmp_path / "evaluations.npz")["timesteps"][0], 32)


def test_eval_friendly_error(algorithm: type[Any]) -> None:
    """Normalized training is not evaluated without normalization."""
    train = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    plain = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    model = make(algorithm, train)
    callback = EvalCallback(plain, eval_freq=10, warn=False)
    with pytest.raises(AssertionError, match="VecNormalize"):
        model.learn(32, callback)


def test_checkpoint_additional_info(algorithm: type[Any], tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    model = make(algorithm, env)
    for kind in (CheckpointCallback, RolloutCheckpointCallback):
        callback = kind(32, str(tmp_path), name_prefix=kind.__name__, save_vecnormalize=True)
        model.learn(64, callback=callback)
        assert (tmp_path / f"{kind.__name__}_32_steps.zip").exists()
        stats = tmp_path / f"{kind.__name__}_vecnormalize_32_steps.pkl"
        loaded: Any = VecNormalize.load(str(stats), make_vec_env("Pendulum-v1"))
        assert np.isfinite(loaded.obs_rms.mean).all()


# Learning again


def test_learn_twice(algorithm: type[Any]) -> None:
    model = make(algorithm, learning_rate=lambda progress: 1e-3 * progress).learn(32)
    assert (model.num_timesteps, n_updates(model)) == (32, 2)
    model.learn(32)
    assert (model.num_timesteps, n_updates(model)) == (32, 4)
    model.learn(17, reset_num_timesteps=False)
    assert (model.num_timesteps, n_updates(model)) == (64, 6)
    # The progress ends there, though the last rollout goes beyond the 49 steps.
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.0


def test_learn_in_parts_goes_on_in_the_same_episode(algorithm: type[Any]) -> None:
    resets = []

    class Counted(Outcome):
        def reset(self, **options: Any) -> Any:
            resets.append(1)
            return super().reset(**options)

    env = DummyVecEnv([lambda: Monitor(Counted())])
    model = make(algorithm, env, n_steps=4, batch_size=4)
    for part in range(3):
        model.learn(4, reset_num_timesteps=part == 0)
    assert len(resets) == 1 + 12 // 5


# Logs


class LogLines(BaseCallback):
    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.keys = set(self.logger.name_to_value)


@pytest.mark.parametrize(
    "formats", [["stdout"], ["log"], ["csv"], ["json"], ["tensorboard"]], ids=str
)
def test_logger_formats(
    algorithm: type[Any],
    formats: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if formats == ["tensorboard"]:
        pytest.importorskip("tensorboard")
    model = make(algorithm)
    model.set_logger(configure(str(tmp_path), formats))
    model.learn(96)
    if formats == ["stdout"]:
        assert "policy_gradient_loss" in capsys.readouterr().out
    else:
        assert any(path.stat().st_size > 0 for path in tmp_path.iterdir())


def test_fps_logger(tmp_path: Path) -> None:
    model = make(PolicyFlow)
    model.set_logger(configure(str(tmp_path), ["json"]))
    model.learn(96, LogEveryNTimesteps(n_steps=32), log_interval=None)
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [row["time/total_timesteps"] for row in rows] == [32, 64, 96]
    assert all(row["time/fps"] > 0 for row in rows)


def test_tensorboard_folders_are_numbered(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    model = make(PolicyFlow, tensorboard_log=str(tmp_path)).learn(32)
    model.learn(32)
    model.learn(32, reset_num_timesteps=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["PolicyFlow_1", "PolicyFlow_2"]


# Normalization


def test_vec_normalize_and_sync(algorithm: type[Any]) -> None:
    def normalized() -> VecNormalize:
        return VecNormalize(make_vec_env("Pendulum-v1", 2), clip_obs=5.0)

    env, evaluation = normalized(), normalized()
    evaluation.training, evaluation.norm_reward = False, False
    model = make(algorithm, env).learn(128)
    sync_envs_normalization(env, evaluation)
    mean: Any = evaluate_policy(model, evaluation, 2, warn=False)[0]
    assert mean < -100  # rewards as the environment gives them
    assert np.abs(model.rollout_buffer.observations).max() <= 5.0


def test_goal_env() -> None:
    env = BitFlippingEnv(n_bits=3, continuous=True)
    model = train(PolicyFlow("MultiInputPolicy", env, policy_kwargs=TINY, **SMALL), 64)
    rewards, lengths = evaluate_policy(
        model, Monitor(env), 2, return_episode_rewards=True, warn=False
    )
    assert len(rewards) == 2  # type: ignore[arg-type]
    assert max(lengths) <= 3  # type: ignore[arg-type]


def test_native_vector_environments_train_as_dummy_ones(algorithm: type[Any]) -> None:
    mode = gym.vector.AutoresetMode.SAME_STEP
    native = GymVectorVecEnv(gym.vector.SyncVectorEnv([Outcome] * 2, autoreset_mode=mode))
    runs = [
        weights(make(algorithm, env).learn(128)) for env in (native, DummyVecEnv([Outcome] * 2))
    ]
    assert th.equal(*runs)


# PPO's own


@pytest.mark.parametrize("clip_range_vf", [None, 0.2, -0.2])
def test_ppo(algorithm: type[Any], clip_range_vf: float | None) -> None:
    if clip_range_vf == -0.2:
        with pytest.raises(ValueError, match="clip_range_vf must not be negative"):
            make(algorithm, clip_range_vf=clip_range_vf)
    else:
        model = train(make(algorithm, clip_range_vf=clip_range_vf), 64)
        logged = model.logger.name_to_value
        assert logged.get("train/clip_range_vf") == clip_range_vf


def test_ppo_warnings(algorithm: type[Any]) -> None:
    with pytest.warns(UserWarning, match="the last minibatch of each epoch will have"):
        make(algorithm, n_steps=63)
    with pytest.raises(ValueError, match="Advantages cannot be normalized over one sample"):
        make(algorithm, n_steps=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(algorithm, n_steps=2, batch_size=2)


@pytest.mark.parametrize("normalize_advantage", [False, True])
def test_advantage_normalization(algorithm: type[Any], normalize_advantage: bool) -> None:
    """Twice the advantages make twice the step, unless they are normalized."""

    def step(factor: float) -> float:
        env = TransformReward(gym.make("Pendulum-v1"), lambda reward: factor * float(reward))
        # One step of plain gradient descent, with advantages that are all but the rewards.
        policy_kwargs = {**TINY, "optimizer_class": th.optim.SGD}
        plain = {"batch_size": 16, "gamma": 0.0, "vf_coef": 0.0, "max_grad_norm": None}
        options = {"policy_kwargs": policy_kwargs, "normalize_advantage": normalize_advantage}
        model = make(algorithm, env, learning_rate=1e-2, **plain, **options)
        before = weights(model)
        return (weights(train(model, 16)) - before).norm().item()

    expected = 1.0 if normalize_advantage else 2.0
    assert step(4096.0) / step(2048.0) == pytest.approx(expected, rel=0.02)
