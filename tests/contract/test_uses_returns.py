"""What environments return, in all kinds, and what callbacks see and keep of it."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import PolicyFlow
from tests.contract.uses import Each, Rewards, Simulator, changed_objects, keep, make, steps

# What environments return


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.int8, np.int64, np.uint8])
def test_kinds_of_rewards(any_algorithm: type[Any], dtype: Any) -> None:
    seen = Rewards()
    env = Simulator(rewards=lambda rewards: rewards.astype(dtype))
    make(any_algorithm, env).learn(32, seen)
    # PPO cuts the value of what lies beyond a time limit down to a whole number, if rewards are.
    cut = any_algorithm is PPO and np.issubdtype(dtype, np.integer)
    tolerance = 1.0 if cut else 0.01 if dtype is np.float16 else 1e-5
    np.testing.assert_allclose(seen.stored, np.array(seen.expected), atol=tolerance)


@pytest.mark.parametrize("dones", [np.bool_, np.uint8, np.int64, np.float32, np.float64])
@pytest.mark.parametrize("infos", [list, tuple])
def test_kinds_of_dones_and_infos(any_algorithm: type[Any], dones: Any, infos: Any) -> None:
    seen = Rewards()
    env = Simulator(dones=lambda array: array.astype(dones), infos=infos)
    make(any_algorithm, env).learn(32, seen)
    np.testing.assert_allclose(seen.stored, np.array(seen.expected), atol=1e-5)


@pytest.mark.parametrize("terminal", [list, np.float64, np.atleast_2d])
def test_kinds_of_terminal_observations(any_algorithm: type[Any], terminal: Any) -> None:
    env = Simulator(terminal=terminal if terminal is not np.float64 else lambda x: x.astype("f8"))
    seen = Rewards()
    make(any_algorithm, env).learn(32, seen)
    np.testing.assert_allclose(seen.stored, np.array(seen.expected), atol=1e-5)


class Endless(Simulator):
    """Without time limits, which let PPO take more kinds of arrays.

    :param change: Makes what ``step`` returns of it.
    """

    def __init__(self, change: Any) -> None:
        super().__init__(2)
        self.change = change

    def step_wait(self) -> Any:
        obs, rewards, dones, _ = super().step_wait()
        return self.change(obs, rewards, dones, [{}, {}])


KINDS: dict[str, Any] = {
    "list": lambda obs, rewards, *rest: (obs, rewards.tolist(), *rest),
    "tuple": lambda obs, rewards, *rest: (obs, tuple(rewards), *rest),
    "tensor": lambda obs, rewards, *rest: (obs, th.as_tensor(rewards), *rest),
    "object": lambda obs, rewards, *rest: (obs, rewards.astype(object), *rest),
    "masked": lambda obs, rewards, *rest: (obs, np.ma.array(rewards), *rest),
    "view": lambda obs, rewards, *rest: (obs, rewards[::-1][::-1], *rest),
    "read-only dones": lambda o, r, dones, i: (o, r, np.broadcast_to(dones[0], (2,)), i),
    "array of infos": lambda o, r, d, infos: (o, r, d, np.array(infos, dtype=object)),
    "float64": lambda obs, *rest: (obs.astype(np.float64), *rest),
    "float16": lambda obs, *rest: (obs.astype(np.float16), *rest),
    "fortran": lambda obs, *rest: (np.asfortranarray(obs), *rest),
    "matrix": lambda obs, *rest: (np.asmatrix(obs), *rest),
}


@pytest.mark.parametrize("kind", KINDS)
def test_other_kinds_that_ppo_takes(any_algorithm: type[Any], kind: str) -> None:
    model = make(any_algorithm, Endless(KINDS[kind])).learn(32)
    expected = np.arange(1, 17)[:, None] % 7 + np.arange(2)
    np.testing.assert_array_equal(model.rollout_buffer.rewards, expected)


def test_observations_that_are_lists_are_named(any_algorithm: type[Any]) -> None:
    env = Endless(lambda obs, *rest: (obs.tolist(), *rest))
    with pytest.raises(TypeError, match="Unrecognized type of observation"):
        make(any_algorithm, env).learn(32)


class OwnMemory(Simulator):
    """Returns an array of its own, and looks whether it is as it left it."""

    def __init__(self, read_only: bool) -> None:
        super().__init__(rewards=self.pay)
        self.read_only = read_only
        self.balance, self.record = np.zeros(2, np.float32), np.zeros(2, np.float32)
        self.touched = 0

    def pay(self, rewards: np.ndarray) -> np.ndarray:
        self.touched += not np.array_equal(self.balance, self.record)
        self.balance.flags.writeable = True
        self.balance[:] = rewards
        self.record = self.balance.copy()
        self.balance.flags.writeable = not self.read_only
        return self.balance


@pytest.mark.parametrize("read_only", [False, True])
def test_memory_of_the_environment_is_not_changed(
    any_algorithm: type[Any], read_only: bool
) -> None:
    env = OwnMemory(read_only)
    if any_algorithm is PPO and read_only:  # it adds what lies beyond a time limit in place
        with pytest.raises(ValueError, match="read-only"):
            make(any_algorithm, env).learn(64)
        return
    seen = Rewards()
    make(any_algorithm, env).learn(32, seen)
    np.testing.assert_allclose(seen.stored, np.array(seen.expected), atol=1e-5)
    assert bool(env.touched) is (any_algorithm is PPO)


# What callbacks see


LOCALS = ("rewards", "dones", "infos", "new_obs", "obs_tensor", "actions", "clipped_actions")


@pytest.mark.parametrize("kind", [steps, Simulator])
def test_what_callbacks_keep_does_not_change(any_algorithm: type[Any], kind: Any) -> None:
    kept: list[tuple[str, Any, Any]] = []
    make(any_algorithm, kind(2)).learn(64, keep(kept, (*LOCALS, "values", "log_probs")))
    # PPO adds the values of what lies beyond time limits to the very array.
    assert changed_objects(kept) == ({"rewards"} if any_algorithm is PPO else set())


def test_types_of_locals(algorithm: type[Any]) -> None:
    def types(kind: type[Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def look(callback: Any) -> None:
            for name, value in callback.locals.items():
                dtype = getattr(value, "dtype", None)
                found[name] = (type(value).__name__, dtype, getattr(value, "shape", None))

        make(kind, steps(2)).learn(32, Each(look))
        return found

    expected, found = types(PPO), types(algorithm)
    # Values of what lies beyond time limits are not asked for one by one.
    expected = {name: expected[name] for name in expected if not name.startswith("terminal_")}
    assert expected.keys() <= found.keys()
    for name in expected.keys() - {"self", "log_probs", "rollout_buffer"}:
        assert found[name] == expected[name], name


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize])
def test_locals_env_is_the_users_own(any_algorithm: type[Any], wrap: Any) -> None:
    env = wrap(steps(2))

    def look(callback: Any) -> None:
        assert callback.locals["env"] is callback.training_env is env
        assert isinstance(callback.locals["env"], VecNormalize) is (wrap is VecNormalize)

    make(any_algorithm, env).learn(32, Each(look))


def test_locals_env_is_used(any_algorithm: type[Any]) -> None:
    def use(callback: Any) -> None:
        env = callback.locals["env"]
        assert env.get_attr("time") == [one.time for one in env.envs]
        env.set_attr("length", 7, indices=[1])
        assert env.env_method("observe")[0].shape == (3,)
        env.set_options({"option": 1})
        rewards = env.buf_rews
        rewards[:] = 100.0  # SB3's environments hand out copies

    env = steps(2)
    model = make(any_algorithm, env).learn(32, Each(use))
    assert [one.length for one in env.envs] == [5, 7]  # type: ignore[attr-defined]
    assert model.rollout_buffer.rewards.max() < 50.0


def test_shape_of_a_terminal_observation_is_told() -> None:
    with pytest.raises(ValueError, match=r"has shape \(2,\) at timestep 10, but its space has"):
        make(PolicyFlow, Simulator(terminal=lambda observation: observation[:2])).learn(32)
