"""Collection: the same rewards as SB3's at time limits, and no number that is not finite."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

from sb3_policyflow import PolicyFlow
from tests.helpers import collect, train, weights


class Clock(gym.Env[Any, Any]):
    """Counts its steps; truncated after ``limit`` of them, or terminated if ``ends``."""

    def __init__(self, limit: int = 3, ends: bool = False, as_dict: bool = False) -> None:
        box = spaces.Box(-10, 10, (1,))
        self.as_dict = as_dict
        self.observation_space = spaces.Dict({"time": box}) if as_dict else box
        self.action_space = spaces.Box(-1, 1, (1,))
        self.limit, self.ends = limit, ends

    def observation(self) -> Any:
        obs = np.array([self.time], dtype=np.float32)
        return {"time": obs} if self.as_dict else obs

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        return self.observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        over = self.time >= self.limit
        return self.observation(), 1.0, over and self.ends, over and not self.ends, {}


def clocks(as_dict: bool = False) -> DummyVecEnv:
    limits = [(3, False), (4, False), (3, True)]
    return DummyVecEnv(
        [lambda limit=limit, ends=ends: Clock(limit, ends, as_dict) for limit, ends in limits]
    )


def collected(env: VecEnv, **options: Any) -> PolicyFlow:
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    model = PolicyFlow(policy, env, n_steps=8, batch_size=24, seed=0, **options)
    collect(model)
    return model


def value(model: PolicyFlow, time: float) -> float:
    obs = np.full((1, 1), time, dtype=np.float32)
    as_dict = isinstance(model.observation_space, spaces.Dict)
    with th.no_grad():
        tensor, _ = model.policy.obs_to_tensor({"time": obs} if as_dict else obs)
        return model.policy.predict_values(tensor).item()


@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize("scheme", ["terminal", "current", "none"])
def test_time_limits_are_bootstrapped_and_terminations_are_not(scheme: str, as_dict: bool) -> None:
    model = collected(clocks(as_dict), timeout_bootstrap=scheme)
    expected = np.ones((8, 3))
    for env, limit in [(0, 3), (1, 4)]:
        seen = {"terminal": limit, "current": limit - 1}.get(scheme)
        bonus = 0.0 if seen is None else model.gamma * value(model, seen)
        expected[limit - 1 :: limit, env] += bonus
    np.testing.assert_allclose(model.rollout_buffer.rewards, expected, rtol=1e-6)


def test_same_rewards_as_sb3s_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = collected(clocks())
    # SB3's own loop finds the time limits and bootstraps one by one.
    monkeypatch.setattr(PolicyFlow, "collect_rollouts", OnPolicyAlgorithm.collect_rollouts)
    theirs = collected(clocks())
    np.testing.assert_allclose(ours.rollout_buffer.rewards, theirs.rollout_buffer.rewards, 1e-6)
    assert ours.rollout_buffer.rewards.std() > 0


def test_worker_processes_and_normalized_rewards() -> None:
    env = VecNormalize(SubprocVecEnv([Clock, Clock], start_method="fork"))
    model = PolicyFlow("MlpPolicy", env, n_steps=8, batch_size=16, seed=0)
    train(model, 16)
    assert np.isfinite(model.rollout_buffer.returns).all()
    env.close()


class SeesTrueStep(BaseCallback):
    """What a callback finds in the locals of the loop."""

    def _on_step(self) -> bool:
        assert (self.locals["rewards"] == 1.0).all()
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            assert done == ("terminal_observation" in info)
        self.truncations = getattr(self, "truncations", 0)
        self.truncations += sum(info["TimeLimit.truncated"] for info in self.locals["infos"])
        return True


def test_callbacks_see_rewards_and_infos_of_the_environment() -> None:
    callback = SeesTrueStep()
    PolicyFlow("MlpPolicy", clocks(), n_steps=12, batch_size=36).learn(36, callback)
    assert callback.truncations == 4 + 3


class Broken(Clock):
    """A clock that gives one number that is not finite, after five steps."""

    def __init__(self, what: str, number: float) -> None:
        super().__init__(limit=100)
        self.what, self.number = what, number

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, *rest = super().step(action)
        if self.time == 5:
            if self.what == "observation":
                obs = np.full_like(obs, self.number)
            else:
                reward = self.number
        return obs, reward, *rest  # type: ignore[return-value]


@pytest.mark.parametrize("number", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["observation", "reward"])
def test_numbers_that_are_not_finite_stop_training(what: str, number: float) -> None:
    env = DummyVecEnv([Clock, lambda: Broken(what, number)])
    model = PolicyFlow("MlpPolicy", env, n_steps=8, batch_size=16)
    before = weights(model)
    with pytest.raises(FloatingPointError, match=rf"{what} .* timestep 10, in environment 1"):
        model.learn(100)
    assert th.equal(weights(model), before)
