"""rsl_rl's PPO."""

from collections.abc import Callable
from typing import Any

import torch as th
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from sb3_policyflow.benchmark.speed.rivals import settings
from sb3_policyflow.benchmark.speed.rivals.environments import make_gym_env
from sb3_policyflow.benchmark.speed.rivals.settings import Setting


class TensorEnv:
    """Gymnasium's vector environments as rsl_rl takes them."""

    def __init__(self, setting: Setting) -> None:
        self.env = make_gym_env(setting)
        self.num_envs = setting.n_envs
        self.num_actions = self.env.single_action_space.shape[0]
        self.max_episode_length = 1000
        self.episode_length_buf = th.zeros(self.num_envs, dtype=th.long)
        self.device = "cpu"
        self.cfg: dict[str, Any] = {}
        self._observations = self.env.reset(seed=0)[0]

    def get_observations(self) -> Any:
        """The latest observations."""
        observations = th.as_tensor(self._observations, dtype=th.float32)
        return TensorDict({"policy": observations}, batch_size=[self.num_envs])

    def step(self, actions: th.Tensor) -> Any:
        """Observations, rewards, ends of episodes, and which of them are due to a time limit."""
        self._observations, rewards, terminated, truncated, _ = self.env.step(actions.numpy())
        dones = th.as_tensor(terminated | truncated)
        extras = {"time_outs": th.as_tensor(truncated)}
        return self.get_observations(), th.as_tensor(rewards, dtype=th.float32), dones, extras


def make(setting: Setting) -> Callable[[], None]:
    """PPO of rsl_rl, which clips the gradients of actor and critic apart."""
    network = {"class_name": "MLPModel", "hidden_dims": setting.net_arch, "activation": "tanh"}
    gaussian = {"class_name": "GaussianDistribution", "std_type": "log"}
    algorithm = {
        "class_name": "PPO",
        "num_learning_epochs": setting.n_epochs,
        "num_mini_batches": setting.n_minibatches,
        "clip_param": settings.CLIP_RANGE,
        "gamma": settings.GAMMA,
        "lam": settings.GAE_LAMBDA,
        "value_loss_coef": settings.VF_COEF,
        "entropy_coef": 0.0,
        "learning_rate": settings.LEARNING_RATE,
        "max_grad_norm": settings.MAX_GRAD_NORM,
        "use_clipped_value_loss": False,
        "schedule": "fixed",
        "normalize_advantage_per_mini_batch": True,
    }
    options = {
        "num_steps_per_env": setting.n_steps,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {**network, "distribution_cfg": gaussian},
        "critic": network,
        "algorithm": algorithm,
    }
    runner: Any = OnPolicyRunner(TensorEnv(setting), options, log_dir=None, device="cpu")
    return lambda: runner.learn(1)
