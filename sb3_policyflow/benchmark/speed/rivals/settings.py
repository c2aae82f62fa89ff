"""What is trained, and by whom: the same for all."""

from collections.abc import Mapping
from dataclasses import dataclass

LEARNING_RATE = 3e-4
GAMMA = 0.99
GAE_LAMBDA = 0.95
CLIP_RANGE = 0.2
VF_COEF = 0.5
MAX_GRAD_NORM = 0.5


@dataclass(frozen=True)
class Setting:
    """Environments, rollouts, minibatches and networks.

    All have SB3's values for the rest: advantages are normalized in each minibatch, values are not
    clipped, no bonus for entropy, Adam, one limit for the norm of gradients.

    :param env: The environment's id. Pendulum-v1 is a batch of arrays, ``pendulum.py``, for all;
        others are stepped one by one, as each library does it.
    :param n_envs: Number of environments.
    :param n_steps: Steps of each in a rollout.
    :param batch_size: Samples in a minibatch.
    :param n_epochs: How often each sample is used.
    :param net_arch: Sizes of the hidden layers of actor and critic, which share none; tanh.
    """

    env: str
    n_envs: int
    n_steps: int
    batch_size: int
    n_epochs: int
    net_arch: tuple[int, ...]

    @property
    def title(self) -> str:
        """What tables call it."""
        return f"{self.env}, {self.n_envs} envs x {self.n_steps}"

    @property
    def n_minibatches(self) -> int:
        """Minibatches of an epoch."""
        return self.n_envs * self.n_steps // self.batch_size


SETTINGS: Mapping[str, Setting] = {
    "halfcheetah": Setting("HalfCheetah-v5", 8, 256, 64, 10, (64, 64)),
    "pendulum": Setting("Pendulum-v1", 1024, 24, 6144, 5, (256, 128, 64)),
    "tiny": Setting("Pendulum-v1", 4, 16, 32, 2, (8, 8)),
}
DEFAULT_SETTINGS = ("halfcheetah", "pendulum")


@dataclass(frozen=True)
class Rival:
    """Who trains.

    :param title: What tables call it.
    :param module: Its module in ``adapters``.
    :param package: The package that it is in, as pip knows it.
    """

    title: str
    module: str
    package: str


RIVALS: Mapping[str, Rival] = {
    "ppo": Rival("SB3's PPO", "sb3", "stable-baselines3"),
    "policyflow": Rival("PolicyFlow", "policyflow", "sb3-policyflow"),
    "sbx": Rival("SBX's PPO", "sbx_ppo", "sbx-rl"),
    "rlox": Rival("rlox's PPO", "rlox_ppo", "rlox"),
    "skrl": Rival("skrl's PPO", "skrl_ppo", "skrl"),
    "rsl_rl": Rival("rsl_rl's PPO", "rsl_rl_ppo", "rsl-rl-lib"),
    "compiled": Rival("one file, torch.compile", "compiled", "torch"),
}
REFERENCE = "ppo"
"""Whose time the ratios are to."""
