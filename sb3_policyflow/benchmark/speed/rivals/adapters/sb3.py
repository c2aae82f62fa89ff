"""Stable-Baselines3's PPO, and what has its interface."""

from collections.abc import Callable
from typing import Any

from stable_baselines3 import PPO
from torch import nn

from sb3_policyflow.benchmark.speed.rivals import settings
from sb3_policyflow.benchmark.speed.rivals.environments import make_sb3_env
from sb3_policyflow.benchmark.speed.rivals.settings import Setting


def make(setting: Setting) -> Callable[[], None]:
    """SB3's PPO."""
    return make_with(PPO, setting, {"activation_fn": nn.Tanh})


def make_with(
    algorithm: Any, setting: Setting, policy_kwargs: dict[str, Any]
) -> Callable[[], None]:
    """Any class with the arguments of SB3's PPO.

    :param algorithm: The class.
    :param policy_kwargs: Of its policy, without ``net_arch``.
    """
    net_arch = list(setting.net_arch)
    model = algorithm(
        "MlpPolicy",
        make_sb3_env(setting),
        learning_rate=settings.LEARNING_RATE,
        n_steps=setting.n_steps,
        batch_size=setting.batch_size,
        n_epochs=setting.n_epochs,
        gamma=settings.GAMMA,
        gae_lambda=settings.GAE_LAMBDA,
        clip_range=settings.CLIP_RANGE,
        vf_coef=settings.VF_COEF,
        max_grad_norm=settings.MAX_GRAD_NORM,
        policy_kwargs={"net_arch": {"pi": net_arch, "vf": net_arch}, **policy_kwargs},
        seed=0,
        device="cpu",
    )
    n_samples = setting.n_envs * setting.n_steps
    options: dict[str, Any] = {"reset_num_timesteps": False, "log_interval": 1_000_000}
    return lambda: model.learn(n_samples, **options) and None
