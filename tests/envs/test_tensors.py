"""Environments of tensors are those of arrays."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_policyflow.envs.multigoal import MultiGoalTensorEnv, MultiGoalVecEnv
from sb3_policyflow.envs.playground.tensors import PlaygroundTensorEnv
from sb3_policyflow.envs.tensor import TensorEnvAdapter, TensorVecEnv


def test_multigoal_is_the_same_in_torch() -> None:
    arrays, tensors = MultiGoalVecEnv(16, seed=3), TensorEnvAdapter(MultiGoalTensorEnv(16))
    tensors.seed(3)
    np.testing.assert_array_equal(arrays.reset(), tensors.reset())
    generator = np.random.default_rng(0)
    n_ended = 0
    for _ in range(120):
        actions = generator.uniform(-6, 6, (16, 2)).astype(np.float32)
        one, other = arrays.step(actions), tensors.step(actions)
        for ours, theirs in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)
        for index in np.flatnonzero(one[2]):
            n_ended += 1
            for name in ("TimeLimit.truncated", "is_success"):
                assert one[3][index][name] == other[3][index][name]
            finals = (infos[index]["terminal_observation"] for infos in (one[3], other[3]))
            np.testing.assert_array_equal(*finals)
    assert n_ended > 16


class Step(NamedTuple):
    """What Playground's environment returns; the type needs JAX."""

    observations: th.Tensor
    rewards: th.Tensor
    terminated: th.Tensor
    truncated: th.Tensor
    final_observations: th.Tensor


class FakePlayground:
    """Stands in for ``PlaygroundVectorEnv``: all of its episodes end."""

    num_envs = 3
    single_observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    single_action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    seeds: list[Any]

    def __init__(self) -> None:
        self.seeds = []

    def reset_tensors(self, seed: int | None = None) -> th.Tensor:
        self.seeds.append(seed)
        return th.zeros(3, 2)

    def step_tensors(self, actions: th.Tensor) -> Step:
        flag = th.tensor([False, True, False])
        finals = th.arange(6.0).reshape(3, 2)
        return Step(th.zeros(3, 2), actions.sum(1), flag, ~flag, finals)


def test_playground_has_final_observations_only_where_an_episode_ended() -> None:
    fake = FakePlayground()
    env = PlaygroundTensorEnv(fake)
    assert isinstance(env, TensorVecEnv)
    env.seed(5)
    env.reset()
    assert fake.seeds == [None, 5]
    step = env.step(th.ones(3, 1))
    assert step.ended.tolist() == [0, 1, 2]
    assert step.final_observations.tolist() == [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]


def test_a_part_of_a_batch_cannot_be_changed() -> None:
    env = TensorEnvAdapter(MultiGoalTensorEnv(2))
    with pytest.raises(ValueError, match="for all of them"):
        env.set_attr("max_episode_steps", 3, indices=[0])
    env.set_attr("max_episode_steps", 3)
    assert env.get_attr("max_episode_steps") == [3, 3]
