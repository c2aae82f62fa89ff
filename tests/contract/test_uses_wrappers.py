"""Wrappers and vectorized environments of users' own, and what callbacks see and keep of them."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
)

from tests.contract.uses import (
    ACTIONS,
    OBSERVATIONS,
    Steps,
    make,
    steps,
)
from tests.helpers import assert_trained, weights, within

pytestmark = pytest.mark.slow

# What wrappers override


class OverridesStep(VecEnvWrapper):
    """Replaces actions by 0 and rewards by 5, in ``step``."""

    n_steps = 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()

    def step(self, actions: np.ndarray) -> Any:
        self.n_steps += 1
        obs, rewards, dones, infos = self.venv.step(np.zeros_like(actions))
        return obs, np.full_like(rewards, 5.0), dones, infos


class OverridesBothHalves(VecEnvWrapper):
    """The same, in ``step_async`` and ``step_wait``."""

    n_steps = 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.n_steps += 1
        self.venv.step_async(np.zeros_like(actions))

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step_wait()
        return obs, np.full_like(rewards, 5.0), dones, infos


class StepsWhenWaitedFor(OverridesBothHalves):
    """The same, with a ``step_async`` that only keeps the action."""

    def step_async(self, actions: np.ndarray) -> None:
        self.n_steps += 1
        self.kept = np.zeros_like(actions)

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step(self.kept)
        return obs, np.full_like(rewards, 5.0), dones, infos


WRAPPERS = [OverridesStep, OverridesBothHalves, StepsWhenWaitedFor]


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_what_wrappers_override_counts(any_algorithm: type[Any], wrapper: Any) -> None:
    env = steps(2, length=1000)
    model = make(any_algorithm, wrapper(env)).learn(64)
    assert model.env.n_steps == 32
    np.testing.assert_array_equal(model.rollout_buffer.rewards, 5.0)
    received = np.array([wrapped.actions for wrapped in env.envs])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(received, 0.0)


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize(
    "others",
    [(VecMonitor,), (VecMonitor, VecNormalize), (VecCheckNan, VecNormalize)],
)
@pytest.mark.parametrize("is_outermost", [True, False])
def test_order_of_wrappers(
    algorithm: type[Any], wrapper: Any, others: Any, is_outermost: bool
) -> None:
    """A wrapper is used where PPO uses it: a ``step`` that is not the outermost is never called."""
    counts = []
    for kind in (PPO, algorithm):
        own = env = wrapper(steps(2)) if not is_outermost else steps(2)
        for other in others:
            env = other(env)
        if is_outermost:
            own = env = wrapper(env)
        model = make(kind, env).learn(32)
        assert model.get_env() is env
        counts.append(own.n_steps)
    assert counts[0] == counts[1]


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["fork", "forkserver"])
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_wrappers_around_workers(any_algorithm: type[Any], wrapper: Any, start_method: str) -> None:
    kwargs = {"start_method": start_method}
    env = make_vec_env(Steps, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=kwargs)
    try:
        with within(15):
            model = make(any_algorithm, wrapper(env)).learn(32)
        assert model.env.n_steps == 16
    finally:
        for process in env.processes:  # type: ignore[attr-defined]
            process.terminate()


class WithoutSuper(VecEnvWrapper):
    """As SuperSuit's, it says itself what SB3's constructor would say."""

    def __init__(self, venv: VecEnv) -> None:
        self.venv = venv
        self.num_envs = venv.num_envs
        self.observation_space, self.action_space = venv.observation_space, venv.action_space
        self.n_resets = 0

    def reset(self) -> Any:
        self.n_resets += 1
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()


@pytest.mark.parametrize("monitored", [False, True])
def test_wrapper_without_super_init(any_algorithm: type[Any], monitored: bool) -> None:
    wrapper = WithoutSuper(VecMonitor(steps(2)) if monitored else steps(2))
    model = make(any_algorithm, wrapper).learn(64)
    assert (model.num_timesteps, wrapper.n_resets) == (64, 1)
    assert len(model.ep_info_buffer) == (2 * (32 // 5) if monitored else 0)


def refusing(error: type[Exception]) -> type[VecEnv]:
    """A simulator that implements ``step`` and little else."""

    class StepOnly(VecEnv):
        observation_space, action_space = OBSERVATIONS, ACTIONS
        num_envs: Any = property(lambda self: 4)

        def __init__(self) -> None:
            pass

        def reset(self) -> Any:
            return np.zeros((4, 3), np.float32)

        def step(self, actions: np.ndarray) -> Any:
            obs = np.zeros((4, 3), np.float32)
            return obs, np.zeros(4, np.float32), np.zeros(4, bool), [{}] * 4

        def get_attr(self, *_: Any, **__: Any) -> Any:
            raise error("not implemented")

        step_async = step_wait = set_attr = env_method = get_attr

        def env_is_wrapped(self, *_: Any) -> list[bool]:
            return [False] * 4

        def close(self) -> None:
            pass

    return StepOnly


@pytest.mark.parametrize("error", [RuntimeError, NotImplementedError, AttributeError])
def test_simulator_with_step_only(any_algorithm: type[Any], error: type[Exception]) -> None:
    env = refusing(error)()
    assert make(any_algorithm, env).learn(128).num_timesteps == 128


# Runs


def test_wrapped_run_trains(any_algorithm: type[Any]) -> None:
    """All at once, in two runs of ``learn``, one going on from the other."""
    model = make(any_algorithm, OverridesStep(VecNormalize(VecMonitor(steps(2)))))
    before = weights(model)
    model.learn(64).learn(64, reset_num_timesteps=False)
    assert_trained(model, before)
    assert (model.num_timesteps, model.env.n_steps) == (128, 64)


def test_set_env_of_another_kind(any_algorithm: type[Any]) -> None:
    model = make(any_algorithm, steps(2)).learn(32)
    model.set_env(OverridesStep(steps(2, length=1000)))
    model.learn(32, reset_num_timesteps=False)
    np.testing.assert_array_equal(model.rollout_buffer.rewards, 5.0)
