"""A setting's environments, as SB3 and as Gymnasium have them."""

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_policyflow.benchmark.speed.rivals.pendulum import PendulumVectorEnv
from sb3_policyflow.benchmark.speed.rivals.settings import Setting
from sb3_policyflow.envs.vector import GymVectorVecEnv


def make_gym_env(setting: Setting) -> Any:
    """For libraries that take Gymnasium's vector environments."""
    if setting.env == "Pendulum-v1":
        return PendulumVectorEnv(setting.n_envs)
    options = {"autoreset_mode": AutoresetMode.SAME_STEP}
    return gym.make_vec(setting.env, setting.n_envs, "sync", vector_kwargs=options)


def make_sb3_env(setting: Setting) -> VecEnv:
    """For SB3 and what is built on it."""
    if setting.env == "Pendulum-v1":
        return VecMonitor(GymVectorVecEnv(PendulumVectorEnv(setting.n_envs)))
    return make_vec_env(setting.env, setting.n_envs, seed=0)
