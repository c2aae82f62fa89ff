"""skrl's PPO."""

from collections.abc import Callable
from typing import Any

import torch as th
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from torch import nn

from sb3_policyflow.benchmark.speed.rivals import settings
from sb3_policyflow.benchmark.speed.rivals.adapters.networks import tanh_network
from sb3_policyflow.benchmark.speed.rivals.environments import make_gym_env
from sb3_policyflow.benchmark.speed.rivals.settings import Setting


class Policy(GaussianMixin, Model):
    """A Gaussian of a network."""

    def __init__(self, env: Any, net_arch: tuple[int, ...]) -> None:
        spaces = {name: getattr(env, name) for name in ("observation_space", "action_space")}
        Model.__init__(self, **spaces, device="cpu")
        GaussianMixin.__init__(self)
        self.net = tanh_network(self.num_observations, net_arch, self.num_actions)
        self.log_std = nn.Parameter(th.zeros(self.num_actions))

    def compute(self, inputs: dict[str, Any], role: str = "") -> Any:  # noqa: ARG002
        """Mean and logarithmic standard deviation."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """The value of a network."""

    def __init__(self, env: Any, net_arch: tuple[int, ...]) -> None:
        spaces = {name: getattr(env, name) for name in ("observation_space", "action_space")}
        Model.__init__(self, **spaces, device="cpu")
        DeterministicMixin.__init__(self)
        self.net = tanh_network(self.num_observations, net_arch, 1)

    def compute(self, inputs: dict[str, Any], role: str = "") -> Any:  # noqa: ARG002
        """The value."""
        return self.net(inputs["observations"]), {}


def make(setting: Setting) -> Callable[[], None]:
    """PPO of skrl, which normalizes the advantages of a rollout, not of a minibatch."""
    env: Any = wrap_env(make_gym_env(setting), wrapper="gymnasium", verbose=False)
    agent = PPO(
        models={"policy": Policy(env, setting.net_arch), "value": Value(env, setting.net_arch)},
        memory=RandomMemory(memory_size=setting.n_steps, num_envs=setting.n_envs, device="cpu"),
        observation_space=env.observation_space,
        action_space=env.action_space,
        device="cpu",
        cfg={
            "rollouts": setting.n_steps,
            "learning_epochs": setting.n_epochs,
            "mini_batches": setting.n_minibatches,
            "learning_rate": settings.LEARNING_RATE,
            "discount_factor": settings.GAMMA,
            "gae_lambda": settings.GAE_LAMBDA,
            "ratio_clip": settings.CLIP_RANGE,
            "value_clip": 0.0,
            "value_loss_scale": settings.VF_COEF,
            "grad_norm_clip": settings.MAX_GRAD_NORM,
            "time_limit_bootstrap": True,
            "experiment": {"write_interval": 0, "checkpoint_interval": 0},
        },
    )
    options = {"timesteps": setting.n_steps, "headless": True, "disable_progressbar": True}
    trainer: Any = SequentialTrainer(env=env, agents=agent, cfg=options)
    return lambda: trainer.train()  # goes on where it was: the wrapper resets once
