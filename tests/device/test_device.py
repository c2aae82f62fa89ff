"""Rollouts of tensors are those of arrays, and everything around them is the same."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_policyflow import DPPO, PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalTensorEnv, MultiGoalVecEnv
from sb3_policyflow.envs.tensor import TensorEnvAdapter, TensorStep, TensorVecEnv
from tests.helpers import train, weights

N_ENVS, N_STEPS = 32, 16


def model_in(env: Any, algorithm: type[Any] = PolicyFlow, **options: Any) -> Any:
    sizes = {"n_steps": N_STEPS, "batch_size": 128, "n_epochs": 2, "seed": 0}
    return algorithm("MlpPolicy", env, **{**sizes, **options})


@pytest.mark.parametrize("bootstrap", ["terminal", "current", "none"])
def test_parameters_are_those_of_the_route_through_arrays(
    algorithm: type[Any], bootstrap: str
) -> None:
    # Episodes of 10 steps: many end by the time limit, some at the walls.
    options = {"desired_kl": 0.01, "timeout_bootstrap": bootstrap}
    models = []
    for env in (MultiGoalVecEnv, MultiGoalTensorEnv):
        model = model_in(env(N_ENVS, max_episode_steps=10), algorithm, **options)
        models.append(train(model, 3 * N_ENVS * N_STEPS))
    arrays, tensors = models
    assert th.equal(weights(arrays), weights(tensors))
    np.testing.assert_array_equal(arrays._last_obs, tensors._last_obs)


def test_normalized_rollouts_and_their_file(tmp_path: Path) -> None:
    envs = MultiGoalVecEnv(N_ENVS), TensorEnvAdapter(MultiGoalTensorEnv(N_ENVS))
    arrays, tensors = (train(model_in(VecNormalize(e)), 3 * N_ENVS * N_STEPS) for e in envs)
    of_arrays, of_tensors = arrays.env, tensors.env
    assert of_arrays.obs_rms.count == of_tensors.obs_rms.count
    for name in ("obs_rms", "ret_rms"):
        one, other = getattr(of_arrays, name), getattr(of_tensors, name)
        # NumPy takes means of observations in single precision.
        np.testing.assert_allclose(one.mean, other.mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(one.var, other.var, rtol=1e-4)
    np.testing.assert_allclose(weights(arrays), weights(tensors), atol=1e-3)
    of_tensors.save(str(tmp_path / "statistics.pkl"))
    loaded = VecNormalize.load(str(tmp_path / "statistics.pkl"), MultiGoalVecEnv(N_ENVS))
    np.testing.assert_array_equal(loaded.obs_rms.mean, of_tensors.obs_rms.mean)


def test_log_and_callbacks_are_sb3s() -> None:
    class Seen(BaseCallback):
        episodes: list[Any]
        calls: list[str]

        def _on_training_start(self) -> None:
            self.episodes, self.calls = [], ["training"]

        def _on_rollout_start(self) -> None:
            self.calls.append("start")

        def _on_step(self) -> bool:
            assert len(self.locals["infos"]) == N_ENVS
            assert self.locals["new_obs"].shape == (N_ENVS, 4)
            self.episodes += [i["episode"] for i in self.locals["infos"] if "episode" in i]
            return True

        def _on_rollout_end(self) -> None:
            self.calls.append("end")

    logs, episodes = [], []
    for env in (VecMonitor(MultiGoalVecEnv(N_ENVS)), MultiGoalTensorEnv(N_ENVS)):
        seen = Seen()
        model = model_in(env).learn(4 * N_ENVS * N_STEPS, callback=seen)
        assert seen.calls == ["training", *["start", "end"] * 4]
        logs.append(dict(model.logger.name_to_value))
        episodes.append([(round(e["r"], 4), e["l"]) for e in seen.episodes])
    assert episodes[0] == episodes[1]
    assert len(episodes[1]) >= N_ENVS
    assert logs[0].keys() == logs[1].keys()


def test_statistics_of_episodes_are_logged() -> None:
    model = model_in(MultiGoalTensorEnv(N_ENVS))
    model.learn(4 * N_ENVS * N_STEPS)
    lengths = [episode["l"] for episode in model.ep_info_buffer]
    assert max(lengths) == 50
    assert len(model.ep_success_buffer) == len(lengths)


def test_save_resume_and_evaluate(tmp_path: Path) -> None:
    model = model_in(MultiGoalTensorEnv(N_ENVS)).learn(N_ENVS * N_STEPS)
    model.save(tmp_path / "model")
    resumed = [
        PolicyFlow.load(tmp_path / "model", env=MultiGoalTensorEnv(N_ENVS)) for _ in range(2)
    ]
    for each in resumed:
        each.learn(N_ENVS * N_STEPS, reset_num_timesteps=False)
    assert th.equal(weights(resumed[0]), weights(resumed[1]))
    adapter = TensorEnvAdapter(MultiGoalTensorEnv(4, seed=0))
    returns, _ = evaluate_policy(model, VecMonitor(adapter), n_eval_episodes=4)
    assert 0 < returns < 10


class Broken(MultiGoalTensorEnv):
    """Returns a reward that is not finite in its 20th step."""

    n_calls = 0

    def step(self, actions: th.Tensor) -> TensorStep:
        self.n_calls += 1
        step = super().step(actions)
        if self.n_calls == 20:
            step.rewards[3] = th.nan
        return step


def test_a_number_that_is_not_finite_stops_before_the_update() -> None:
    model = model_in(VecNormalize(TensorEnvAdapter(Broken(N_ENVS))))
    with pytest.raises(FloatingPointError, match="reward is not finite at timestep 640"):
        model.learn(4 * N_ENVS * N_STEPS)
    assert np.isfinite(model.env.ret_rms.var)


class DictEnv:
    """Two observations, one of which is the action before."""

    num_envs = N_ENVS
    device = th.device("cpu")
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gym.spaces.Dict(
        step=gym.spaces.Box(0.0, 100.0, (1,), np.float32), action=action_space
    )

    def reset(self) -> dict[str, th.Tensor]:
        self.steps = th.zeros(N_ENVS, 1)
        return {"step": self.steps.clone(), "action": th.zeros(N_ENVS, 2)}

    def step(self, actions: th.Tensor) -> TensorStep:
        self.steps += 1
        final = {"step": self.steps.clone(), "action": actions.clone()}
        truncated = self.steps.flatten() >= 7
        ended = truncated.nonzero().flatten()
        self.steps[ended] = 0.0
        return TensorStep(
            {"step": self.steps.clone(), "action": actions.clone()},
            -actions.square().sum(dim=1),
            th.zeros(N_ENVS, dtype=th.bool),
            truncated,
            ended,
            {key: values[ended] for key, values in final.items()},
        )


def test_dictionaries_of_observations_in_a_users_own_class(algorithm: type[Any]) -> None:
    assert isinstance(DictEnv(), TensorVecEnv)
    sizes = {"n_steps": N_STEPS, "batch_size": 128, "n_epochs": 1, "seed": 0}
    models = [
        train(algorithm("MultiInputPolicy", env, **sizes), 2 * N_ENVS * N_STEPS)
        for env in (DictEnv(), VecMonitor(TensorEnvAdapter(DictEnv())))
    ]
    assert th.equal(weights(models[0]), weights(models[1]))


class Bounded(MultiGoalTensorEnv):
    """Has bounds that scaled actions leave by their rounding, and looks at what it is given."""

    def __init__(self, n_envs: int) -> None:
        super().__init__(n_envs)
        low, high = np.random.default_rng(0).uniform([[-3.0], [0.0]], [[0.0], [3.0]], (2, 2))
        self.action_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self.n_at_bounds = 0

    def step(self, actions: th.Tensor) -> TensorStep:
        low, high = th.as_tensor(self.action_space.low), th.as_tensor(self.action_space.high)
        assert (actions >= low).all()
        assert (actions <= high).all()
        self.n_at_bounds += int((actions == high).sum())
        return super().step(actions)


def test_scaled_actions_stay_within_their_bounds() -> None:
    env = Bounded(N_ENVS)
    train(model_in(env, DPPO, process="ddpm"), N_ENVS * N_STEPS)
    assert env.n_at_bounds > 0


def test_the_class_in_the_documentation() -> None:
    page = Path(__file__).parents[2] / "docs" / "tensors.md"
    blocks = page.read_text(encoding="utf-8").split("```python\n")[1:]
    (block,) = [block.split("```")[0] for block in blocks if "class Reach" in block]
    names: dict[str, Any] = {}
    exec(block, names)
    model = train(model_in(names["Reach"](N_ENVS)), 8 * N_ENVS * N_STEPS)
    assert [episode["l"] for episode in model.ep_info_buffer] == [100] * N_ENVS
