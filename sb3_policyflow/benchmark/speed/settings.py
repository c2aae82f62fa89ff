"""What the speed benchmark trains: pairs with equal environments, networks and batches."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.envs.tensor import TensorStep
from sb3_policyflow.envs.vector import GymVectorVecEnv

Options = Mapping[str, Any]
Make = Callable[[], OnPolicyAlgorithm]


class NoiseEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Environments of random observations that take no time, to see what the rest takes.

    :param num_envs: Number of environments.
    :param obs_dim: Dimensions of an observation.
    :param action_dim: Dimensions of an action.
    """

    def __init__(self, num_envs: int, obs_dim: int, action_dim: int) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (action_dim,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng(0)

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw observations."""
        size = self.observation_space.shape
        return self._rng.standard_normal(size, dtype=np.float32), {}

    def step(
        self,
        actions: np.ndarray,  # noqa: ARG002
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Draw observations, for no reward and without an end."""
        never = np.zeros(self.num_envs, dtype=bool)
        observations, infos = self.reset()
        return observations, np.zeros(self.num_envs), never, never, infos


class NoiseTensorEnv:
    """:class:`NoiseEnv` as a ``TensorVecEnv``.

    :param num_envs: Number of environments.
    :param obs_dim: Dimensions of an observation.
    :param action_dim: Dimensions of an action.
    :param device: Where the tensors are.
    """

    def __init__(self, num_envs: int, obs_dim: int, action_dim: int, device: str) -> None:
        self.num_envs, self.device = num_envs, get_device(device)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (action_dim,), np.float32)
        self._rewards = th.zeros(num_envs, device=self.device)
        self._never = self._rewards.bool()
        self._ended = self._rewards[:0].long()

    def reset(self) -> th.Tensor:
        """Draw observations."""
        return th.randn(self.num_envs, *self.observation_space.shape, device=self.device)

    def step(self, actions: th.Tensor) -> TensorStep:  # noqa: ARG002
        """Draw observations, for no reward and without an end."""
        observations, never = self.reset(), self._never
        return TensorStep(observations, self._rewards, never, never, self._ended, observations[:0])


@dataclass(frozen=True)
class Setting:
    """Ways to train, which are compared with the last of them.

    :param title: What the table calls it.
    :param makers: Makes each model, by its name.
    """

    title: str
    makers: Mapping[str, Make]


def against_ppo(
    title: str,
    make_env: Callable[[], VecEnv],
    common: Options,
    network: Options | None = None,
    flow: Options | None = None,
    embedding_dim: int = 64,
    device: str = "cpu",
) -> Setting:
    """PolicyFlow against SB3's PPO.

    :param title: What the table calls it.
    :param make_env: Makes the environment.
    :param common: Arguments of both.
    :param network: ``policy_kwargs`` of both.
    :param flow: Arguments of PolicyFlow alone.
    :param embedding_dim: Size of PolicyFlow's embeddings.
    :param device: Where both train.
    """
    both = {"policy": "MlpPolicy", "seed": 0, "device": device, **common}
    policy_kwargs = dict(network or {})
    flow_kwargs = {**policy_kwargs, "embedding_dim": embedding_dim}
    return Setting(
        title,
        {
            "PolicyFlow": lambda: PolicyFlow(
                env=make_env(), policy_kwargs=flow_kwargs, **both, **(flow or {})
            ),
            "PPO": lambda: PPO(env=make_env(), policy_kwargs=policy_kwargs, **both),
        },
    )


def multigoal(n_envs: int = 1024, n_flow_steps: int = 12, embedding_dim: int = 64) -> Setting:
    """The paper's settings for MultiGoal."""
    return against_ppo(
        f"MultiGoal, {n_envs} envs x 24",
        lambda: VecMonitor(MultiGoalVecEnv(n_envs, seed=0)),
        {
            "learning_rate": 2e-4,
            "n_steps": 24,
            "batch_size": 6 * n_envs,
            "n_epochs": 5,
            "clip_range_vf": 0.2,
            "vf_coef": 1.0,
            "ent_coef": 0.001,
        },
        {"net_arch": [256, 128, 64], "activation_fn": th.nn.Mish},
        {"brownian_coef": 0.25, "n_flow_steps": n_flow_steps},
        embedding_dim,
    )


def halfcheetah() -> Setting:
    """HalfCheetah-v5 with a few environments."""
    return against_ppo(
        "HalfCheetah-v5, 8 envs x 256",
        lambda: make_vec_env("HalfCheetah-v5", n_envs=8, seed=0),
        {"n_steps": 256, "batch_size": 64, "n_epochs": 10},
        {"net_arch": [64, 64]},
    )


def pendulum() -> Setting:
    """Pendulum-v1 with SB3's defaults."""
    make_env = lambda: make_vec_env("Pendulum-v1", n_envs=1, seed=0)  # noqa: E731
    return against_ppo("Pendulum-v1, 1 env, SB3's defaults", make_env, {})


def embedding() -> Setting:
    """MultiGoal with large embeddings against small ones."""
    large, small = multigoal(embedding_dim=512), multigoal(embedding_dim=64)
    makers = {"512": large.makers["PolicyFlow"], "64": small.makers["PolicyFlow"]}
    return Setting("MultiGoal, embedding 512 against 64", makers)


def action_dimension(action_dim: int) -> Setting:
    """Random observations, 64 environments, and actions of some dimension."""
    return against_ppo(
        f"{action_dim}-D actions",
        lambda: GymVectorVecEnv(NoiseEnv(64, 17, action_dim)),
        {"n_steps": 32, "batch_size": 256, "n_epochs": 10},
        {"net_arch": [64, 64]},
    )


def isaaclab(embedding_dim: int, device: str) -> Setting:
    """The paper's settings for IsaacLab's quadrupeds, without the simulator.

    PolicyFlow with rollouts of tensors, and through arrays as PPO.
    """

    def by_route(make_env: Callable[[], Any]) -> Mapping[str, Make]:
        return against_ppo(
            title,
            make_env,
            {"n_steps": 24, "batch_size": 4096 * 24 // 4, "n_epochs": 5, "clip_range_vf": 0.2},
            {"net_arch": [512, 256, 128], "activation_fn": th.nn.ELU},
            {"brownian_coef": 0.01},
            embedding_dim,
            device,
        ).makers

    title = f"4096 envs x 24, embedding {embedding_dim}"
    arrays = by_route(lambda: GymVectorVecEnv(NoiseEnv(4096, 48, 12)))
    tensors = by_route(lambda: NoiseTensorEnv(4096, 48, 12, device))
    makers = {
        "PolicyFlow, tensors": tensors["PolicyFlow"],
        "PolicyFlow, arrays": arrays["PolicyFlow"],
        "PPO, arrays": arrays["PPO"],
    }
    return Setting(title, makers)


MAIN: dict[str, Callable[[], Setting]] = {
    "multigoal": multigoal,
    "halfcheetah": halfcheetah,
    "pendulum": pendulum,
    "embedding": embedding,
}

GROWTH: dict[str, tuple[Callable[[int], Setting], tuple[int, ...]]] = {
    "environments": (lambda n: multigoal(n_envs=n), (1, 4, 16, 64, 256, 1024, 4096)),
    "flow steps": (lambda n: multigoal(n_flow_steps=n), (1, 2, 4, 8, 12, 24)),
    "embedding": (lambda n: multigoal(embedding_dim=n), (8, 16, 32, 64, 128, 256, 512)),
    "action dimensions": (action_dimension, (1, 2, 4, 8, 16, 32, 64)),
}
"""What grows, the setting for each value, and the values."""
