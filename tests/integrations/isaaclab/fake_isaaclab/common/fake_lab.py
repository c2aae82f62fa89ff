"""An environment and the parts of IsaacLab that its versions 2 and 3 have in common.

Written after what IsaacLab 2.3.2 and 3.0.0 do, of which nothing is copied.
"""

import importlib
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

LIMIT = 8
"""Steps of an episode."""


@dataclass
class Part:
    """A part of an environment's configuration."""

    num_envs: int = 4
    device: str = "cpu"


@dataclass
class EnvConfig:
    """What a task is configured with. Version 3 has ``compute_final_obs`` on top."""

    scene: Part = field(default_factory=Part)
    sim: Part = field(default_factory=Part)
    seed: int | None = None


class LabEnv(gym.Env[Any, Any]):
    """Points that are pushed: a batch of them is one environment, whose tensors stay on its device.

    Observations are the position, and the time of the episode. Who strays too far is terminated,
    who has had his time is truncated, and the last observation is lost unless it was asked for.
    """

    render_mode = None

    def __init__(self, cfg: Any, **entry_points: Any) -> None:
        self.cfg, self.num_envs, self.device = cfg, cfg.scene.num_envs, cfg.sim.device
        self.single_observation_space = {"policy": spaces.Box(-np.inf, np.inf, (3,))}
        self.single_action_space = spaces.Box(-np.inf, np.inf, (2,))
        self.generator = th.Generator()
        # Written to in each step, as those of the real one are.
        self.rewards = th.zeros(self.num_envs)
        self.terminated, self.truncated = th.zeros(2, self.num_envs, dtype=th.bool)

    def seed(self, seed: int | None = None) -> int | None:
        if seed is not None:
            self.generator.manual_seed(seed)
            th.manual_seed(seed)
            np.random.seed(seed)
        return seed

    def reset(self, **options: Any) -> Any:
        self.position, self.time = self.begin(self.num_envs)
        return self.observe(), {}

    def begin(self, number: int) -> tuple[th.Tensor, th.Tensor]:
        time = th.randint(0, LIMIT, (number,), generator=self.generator)
        return th.randn(number, 2, generator=self.generator), time

    def observe(self) -> dict[str, th.Tensor]:
        return {"policy": th.cat([self.position, self.time.unsqueeze(1)], dim=1)}

    def step(self, action: th.Tensor) -> Any:
        assert isinstance(action, th.Tensor)
        self.position = self.position + 0.3 * action
        self.time = self.time + 1
        distance = self.position.norm(dim=1)
        self.terminated[:], self.truncated[:] = distance > 4, self.time >= LIMIT
        self.rewards[:] = -distance
        over = self.terminated | self.truncated
        extras: dict[str, Any] = {"log": {"reached": distance.mean()}}
        if over.any() and getattr(self.cfg, "compute_final_obs", False):
            extras["final_obs"] = self.observe()
        self.position[over], self.time[over] = self.begin(int(over.sum()))
        return self.observe(), self.rewards, self.terminated, self.truncated, extras

    def close(self) -> None:
        print("environment closed")  # noqa: T201  # the tests look for it


class Sb3Wrapper(VecEnv):
    """What ``Sb3VecEnvWrapper`` shows to SB3, its oddities included."""

    def __init__(self, env: Any, low: float, high: float) -> None:
        self.env = env
        self.returns, self.lengths = np.zeros(self.unwrapped.num_envs), 0
        actions = spaces.Box(low, high, self.unwrapped.single_action_space.shape)
        observations = self.unwrapped.single_observation_space["policy"]
        super().__init__(self.unwrapped.num_envs, observations, actions)

    @property
    def unwrapped(self) -> Any:
        return self.env.unwrapped  # not a VecEnv

    def seed(self, seed: int | None = None) -> Any:
        return [self.unwrapped.seed(seed)] * self.num_envs

    def reset(self) -> Any:
        self.returns, self.lengths = np.zeros(self.num_envs), np.zeros(self.num_envs)
        return self.as_array(self.env.reset()[0])

    def step_async(self, actions: Any) -> None:
        self.actions = th.as_tensor(actions, dtype=th.float32)

    def step_wait(self) -> Any:
        observations, rewards, terminated, truncated, extras = self.env.step(self.actions)
        parts = (rewards.numpy(), terminated.numpy(), truncated.numpy())
        infos = self.make_infos(self.as_array(observations), *parts, extras)
        return self.as_array(observations), parts[0], parts[1] | parts[2], infos

    def make_infos(
        self, observations: Any, rewards: Any, terminated: Any, truncated: Any, extras: Any
    ) -> Any:
        self.returns, self.lengths = self.returns + rewards, self.lengths + 1
        last = self.as_array(extras["final_obs"]) if "final_obs" in extras else observations
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(terminated | truncated):
            infos[index] = {
                "episode": {"r": self.returns[index], "l": self.lengths[index]},  # no "t"
                "TimeLimit.truncated": truncated[index] and not terminated[index],
                "terminal_observation": last[index],
            }
            self.returns[index] = self.lengths[index] = 0
        return infos

    def as_array(self, observations: Any) -> Any:
        return observations["policy"].numpy()

    def get_attr(self, attr_name: str, indices: Any = None) -> Any:
        value = getattr(self.env, attr_name)
        return [value] * (self.num_envs if indices is None else len(indices))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Any:
        return [False]  # of length 1, however many there are

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("Setting attributes is not supported.")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        return getattr(self.env, method_name)(*args, indices=indices, **kwargs)

    def get_images(self) -> Any:
        raise NotImplementedError("Getting images is not supported.")

    def close(self) -> None:
        self.env.close()


def process_sb3_cfg(cfg: dict[str, Any], num_envs: int) -> dict[str, Any]:
    """Plain values of a configuration turned into what SB3 takes."""
    for key, value in cfg.items():
        if isinstance(value, dict):
            cfg[key] = process_sb3_cfg(value, num_envs)
        elif isinstance(value, str) and value.startswith("nn."):
            cfg[key] = getattr(th.nn, value[3:])
        elif key in ("learning_rate", "clip_range", "clip_range_vf"):
            cfg[key] = _schedule(value)
    if "n_minibatches" in cfg:
        cfg["batch_size"] = cfg["n_steps"] * num_envs // cfg.pop("n_minibatches")
    return cfg


def _schedule(value: float | str) -> Any:
    if isinstance(value, str):
        return LinearSchedule(float(value.split("_")[1]), 0.0, 1.0)
    return (lambda _: value) if value >= 0 else value


def register(names: list[str], config: str) -> None:
    """Register tasks, as importing ``isaaclab_tasks`` does."""
    for name in names:
        kwargs = {"env_cfg_entry_point": config, "rsl_rl_cfg_entry_point": "somewhere:else"}
        if name not in gym.registry:
            gym.register(name, "fake_lab:LabEnv", kwargs=kwargs, disable_env_checker=True)


def load(task: str, agent: str) -> tuple[Any, Any]:
    """The configurations of a task and an agent, from the registry."""
    return tuple(_resolve(gym.spec(task).kwargs[key]) for key in ("env_cfg_entry_point", agent))


def _resolve(entry_point: str) -> Any:
    module, name = entry_point.split(":")
    return getattr(importlib.import_module(module), name)()


def override(configured: tuple[Any, Any], overrides: list[str]) -> tuple[Any, Any]:
    """Change configurations as Hydra does."""
    environment, agent = configured
    for text in overrides:
        path, value = text.split("=")
        kind, *keys = path.split(".")
        number: Any = (
            value if not value.replace(".", "").replace("-", "").isdigit() else eval(value)
        )
        if kind == "agent":
            agent[keys[0]] = number
        else:
            for key in keys[:-1]:
                environment = getattr(environment, key)
            setattr(environment, keys[-1], number)
    return configured
