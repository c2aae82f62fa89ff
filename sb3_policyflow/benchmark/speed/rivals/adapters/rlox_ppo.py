"""rlox's PPO (advantages in Rust, networks in PyTorch)."""

from collections.abc import Callable

from rlox.algorithms.ppo import PPO
from rlox.policies import ContinuousPolicy

from sb3_policyflow.benchmark.speed.rivals import settings
from sb3_policyflow.benchmark.speed.rivals.adapters.networks import tanh_network
from sb3_policyflow.benchmark.speed.rivals.environments import make_gym_env
from sb3_policyflow.benchmark.speed.rivals.settings import Setting


def make(setting: Setting) -> Callable[[], None]:
    """PPO of rlox, with its own vectorization of environments that are stepped one by one."""
    env = make_gym_env(setting)
    n_inputs, n_actions = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    policy = ContinuousPolicy(n_inputs, n_actions)
    policy.actor = tanh_network(n_inputs, setting.net_arch, n_actions)
    policy.critic = tanh_network(n_inputs, setting.net_arch, 1)
    algorithm = PPO(
        setting.env,
        n_envs=setting.n_envs,
        policy=policy,
        n_steps=setting.n_steps,
        batch_size=setting.batch_size,
        n_epochs=setting.n_epochs,
        learning_rate=settings.LEARNING_RATE,
        gamma=settings.GAMMA,
        gae_lambda=settings.GAE_LAMBDA,
        clip_eps=settings.CLIP_RANGE,
        clip_vloss=False,
        vf_coef=settings.VF_COEF,
        ent_coef=0.0,
        max_grad_norm=settings.MAX_GRAD_NORM,
        anneal_lr=False,
    )
    if setting.env == "Pendulum-v1":  # one batch of arrays, as for all
        algorithm.collector.env._env = env
    return lambda: algorithm.train(setting.n_envs * setting.n_steps) and None
