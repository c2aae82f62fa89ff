"""Training in IsaacLab's wrapper for Stable-Baselines3, of which the fake keeps the oddities."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import TASKS, THREE, wrapped
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.algorithms import ALGORITHMS
from sb3_policyflow.integrations.isaaclab import presets
from sb3_policyflow.integrations.isaaclab.train import make_parser, read_agent, train


@THREE
@pytest.mark.usefixtures("installed")
def test_bounds_of_actions() -> None:
    assert wrapped().action_space == spaces.Box(-100, 100, (2,))
    assert wrapped(bounds=(-1.0, 1.0)).action_space == spaces.Box(-1, 1, (2,))


@THREE
@pytest.mark.parametrize("final", [False, True])
@pytest.mark.usefixtures("installed")
def test_time_limits_are_bootstrapped_from_what_there_is(
    final: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the last observation where IsaacLab computes it, else from the one before it.

    Observations end with the episode's time, so a critic that returns it tells which one it saw.
    """
    env = wrapped(n_envs=64, final=final)
    limit = importlib.import_module("fake_lab").LIMIT
    bootstrap = "terminal" if final else "current"
    model = PolicyFlow(
        "MlpPolicy", env, n_steps=16, batch_size=256, seed=0, gamma=0.9, timeout_bootstrap=bootstrap
    )
    monkeypatch.setattr(model.policy, "predict_values", lambda observations: observations[:, -1:])
    seen: list[Any] = []

    def keep(variables: Any, _: Any) -> bool:
        seen.append((variables["rewards"].copy(), [dict(info) for info in variables["infos"]]))
        return True

    model.learn(16 * 64, keep)
    truncated = np.array([[bool(i.get("TimeLimit.truncated")) for i in infos] for _, infos in seen])
    bonus = model.rollout_buffer.rewards - np.stack([rewards for rewards, _ in seen])
    assert 50 < truncated.sum() < truncated.size / 4
    expected = 0.9 * (limit if final else limit - 1) * truncated
    np.testing.assert_allclose(bonus, expected, atol=1e-5)


@THREE
@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS.values())
@pytest.mark.usefixtures("installed")
def test_trains_in_4096_environments(algorithm: type[Any], tmp_path: Path) -> None:
    env = wrapped(n_envs=4096)
    options = {"timeout_bootstrap": "current", "seed": 0, "tensorboard_log": str(tmp_path)}
    kwargs = {"net_arch": [16], "embedding_dim": 8}
    model = algorithm(
        "MlpPolicy", env, n_steps=4, batch_size=4096, n_epochs=1, policy_kwargs=kwargs, **options
    ).learn(2 * 4 * 4096)
    assert len(model.ep_info_buffer) == 100
    assert np.isfinite([episode["r"] for episode in model.ep_info_buffer]).all()
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    mean, _ = evaluate_policy(loaded, env, n_eval_episodes=5, warn=False)
    assert np.isfinite(mean)


@THREE
@pytest.mark.usefixtures("installed")
def test_train_returns_a_model_that_can_go_on(tmp_path: Path) -> None:
    env = wrapped(n_envs=8)
    options = make_parser().parse_args(["--task", TASKS["three"], "--log_dir", str(tmp_path)])
    agent, _, _ = read_agent({**presets.flat_anymal_d(), "n_steps": 4}, 8, 1, 0)
    model = train(env, agent, 64, {"normalize_value": True}, options)
    assert isinstance(model.get_env(), VecNormalize)
    assert model.learn(32, reset_num_timesteps=False).num_timesteps == 96
