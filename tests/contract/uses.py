"""What the tests of users' habits share: environments that can be foretold, and small models."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from tests.helpers import SMALL, TINY

OBSERVATIONS = spaces.Box(-1, 1, (3,))
ACTIONS = spaces.Box(-1, 1, (2,))


class Steps(gym.Env[Any, Any]):
    """Nothing in it is random: the observation is a function of the time.

    :param length: Steps of an episode.
    :param is_limit: Whether a time limit ends it.
    """

    observation_space, action_space = OBSERVATIONS, ACTIONS

    def __init__(self, length: int = 5, is_limit: bool = True) -> None:
        self.length, self.is_limit = length, is_limit
        self.actions: list[np.ndarray] = []
        self.time = 0

    def observe(self) -> np.ndarray:
        return np.sin(self.time + np.arange(3.0)).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time = 0
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        self.actions.append(np.array(action))
        is_over = self.time == self.length
        reward = 1.0 - float(np.square(action).mean())
        return self.observe(), reward, is_over and not self.is_limit, is_over and self.is_limit, {}


def steps(n_envs: int = 1, **options: Any) -> DummyVecEnv:
    """Several of them, as SB3 vectorizes them."""
    return DummyVecEnv([lambda: Steps(**options)] * n_envs)


class Simulator(VecEnv):
    """A vectorized environment of one's own, with a time limit after every fifth step.

    :param n_envs: How many.
    :param rewards: Makes what ``step`` returns of whole rewards, shape (n_envs,).
    :param dones: The same, for the ends of episodes.
    :param infos: The same, for the list of dictionaries.
    :param terminal: The same, for the last observation of an episode, shape (3,).
    """

    def __init__(
        self,
        n_envs: int = 2,
        rewards: Callable[[Any], Any] = np.float32,
        dones: Callable[[Any], Any] = np.asarray,
        infos: Callable[[Any], Any] = list,
        terminal: Callable[[Any], Any] = np.asarray,
    ) -> None:
        super().__init__(n_envs, OBSERVATIONS, ACTIONS)
        self.make_rewards, self.make_dones = rewards, dones
        self.make_infos, self.make_terminal = infos, terminal
        self.time = 0

    def observe(self) -> np.ndarray:
        times = self.time + np.arange(3.0) + np.arange(self.num_envs)[:, None]
        return np.sin(times).astype(np.float32)

    def reset(self) -> Any:
        self.time = 0
        return self.observe()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        self.time += 1
        is_over = self.time % 5 == 0
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for info, last in zip(infos if is_over else [], self.observe(), strict=False):
            info["TimeLimit.truncated"] = True
            info["terminal_observation"] = self.make_terminal(last)
        rewards = self.make_rewards(self.time % 7 + np.arange(self.num_envs))
        dones = self.make_dones(np.full(self.num_envs, is_over))
        return self.observe(), rewards, dones, self.make_infos(infos)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        raise AttributeError(attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs

    def close(self) -> None:
        pass


def make(algorithm: type[Any], env: Any = None, policy: Any = "MlpPolicy", **options: Any) -> Any:
    """A small model.

    :param algorithm: PPO or one of ours.
    :param env: The environment; one of :class:`Steps`, if there is none.
    :param policy: Its policy.
    :param options: Options; ``policy_kwargs`` are added to those of the smallest networks.
    """
    sizes = {"net_arch": [8]} if issubclass(algorithm, PPO) else TINY
    policy_kwargs = {**sizes, **options.pop("policy_kwargs", {})}
    chosen = {"device": "cpu", **SMALL, **options}
    return algorithm(policy, steps() if env is None else env, policy_kwargs=policy_kwargs, **chosen)


def learned(algorithm: type[Any], **options: Any) -> Any:
    """A model whose weights are far from where they began."""
    return make(algorithm, **{"learning_rate": 1e-2, **options}).learn(64)


def output_layer(model: Any) -> th.nn.Linear:
    """The layer whose bias moves the deterministic action."""
    policy = model.policy
    layer: th.nn.Linear
    layer = policy.action_net if isinstance(model, PPO) else policy.velocity.output
    return layer


class Each(BaseCallback):
    """Calls a function with itself in every step."""

    def __init__(self, function: Callable[[BaseCallback], object]) -> None:
        super().__init__()
        self.function = function

    def _on_step(self) -> bool:
        self.function(self)
        return True


class Rewards(BaseCallback):
    """What the buffer should hold: rewards as given, and what lies beyond time limits."""

    def _on_training_start(self) -> None:
        self.expected: list[np.ndarray] = []

    def _on_step(self) -> bool:
        rewards = np.array(self.locals["rewards"], dtype=np.float64)
        infos = self.locals["infos"]
        for index in np.flatnonzero(np.asarray(self.locals["dones"])):
            if infos[index].get("TimeLimit.truncated"):
                last = np.asarray(infos[index]["terminal_observation"], np.float32)
                with th.no_grad():
                    value = self.model.policy.predict_values(
                        self.model.policy.obs_to_tensor(last)[0]
                    )
                rewards[index] += self.model.gamma * value.item()
        self.expected.append(rewards)
        return True

    def _on_rollout_end(self) -> None:
        self.stored = self.locals["rollout_buffer"].rewards.copy()


def first_line(error: BaseException) -> str:
    """What a user reads first of an error."""
    return (str(error).splitlines() or [""])[0]


def changed_objects(pairs: list[tuple[str, Any, Any]]) -> set[str]:
    """Names of the objects that differ from their copies.

    :param pairs: Name, object and copy.
    """
    return {name for name, kept, copy in pairs if not _equal(kept, copy)}


def _equal(one: Any, other: Any) -> bool:
    try:
        np.testing.assert_equal(_arrays(one), _arrays(other))
    except AssertionError:
        return False
    return True


def _arrays(value: Any) -> Any:
    """A value with arrays for its tensors."""
    if isinstance(value, th.Tensor):
        return value.numpy()
    if isinstance(value, dict):
        return {key: _arrays(part) for key, part in value.items()}
    return [_arrays(part) for part in value] if isinstance(value, (list, tuple)) else value


def keep(kept: list[tuple[str, Any, Any]], names: tuple[str, ...]) -> Each:
    """A callback that keeps local variables of SB3's loop, each with a copy of it."""
    return Each(
        lambda callback: kept.extend(
            (name, callback.locals[name], deepcopy(callback.locals[name])) for name in names
        )
    )
