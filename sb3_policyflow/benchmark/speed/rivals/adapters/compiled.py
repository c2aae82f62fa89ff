"""PPO in one file, as short as it can be, with ``torch.compile``.

After the manner of CleanRL and LeanRL: no classes of a framework, rollouts in preallocated tensors,
and compiled functions for a step of the policy and for a minibatch. Here the latter is one graph,
with the gradients, their clipping and Adam. Nothing is logged, monitored or saved.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from torch import nn
from torch.func import functional_call, grad

from sb3_policyflow.benchmark.speed.rivals import settings
from sb3_policyflow.benchmark.speed.rivals.adapters.networks import tanh_network
from sb3_policyflow.benchmark.speed.rivals.environments import make_gym_env
from sb3_policyflow.benchmark.speed.rivals.settings import Setting

Tensors = dict[str, th.Tensor]
LOG_SQRT_2_PI = 0.9189385332
BETA_1, BETA_2, ADAM_EPS = 0.9, 0.999, 1e-5


class Agent(nn.Module):
    """Actor and critic, and the loss of a minibatch."""

    def __init__(self, n_inputs: int, n_actions: int, net_arch: tuple[int, ...]) -> None:
        super().__init__()
        self.actor = tanh_network(n_inputs, net_arch, n_actions)
        self.critic = tanh_network(n_inputs, net_arch, 1)
        self.log_std = nn.Parameter(th.zeros(n_actions))

    def log_prob(self, standardized: th.Tensor) -> th.Tensor:
        """Logarithmic density of mean + std * standardized, shape (n,)."""
        return -(0.5 * standardized**2 + self.log_std + LOG_SQRT_2_PI).sum(1)

    def sample(self, observations: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, ...]:
        """Actions, their logarithmic densities, and values."""
        actions = self.actor(observations) + self.log_std.exp() * noise
        return actions, self.log_prob(noise), self.critic(observations).flatten()

    def forward(
        self,
        observations: th.Tensor,
        actions: th.Tensor,
        old_log_prob: th.Tensor,
        advantages: th.Tensor,
        returns: th.Tensor,
    ) -> th.Tensor:
        """PPO's loss."""
        noise = (actions - self.actor(observations)) * (-self.log_std).exp()
        ratio = (self.log_prob(noise) - old_log_prob).exp()
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        clipped = ratio.clamp(1 - settings.CLIP_RANGE, 1 + settings.CLIP_RANGE)
        policy_loss = -th.minimum(advantages * ratio, advantages * clipped).mean()
        value_loss = (returns - self.critic(observations).flatten()).square().mean()
        loss: th.Tensor = policy_loss + settings.VF_COEF * value_loss
        return loss


class Training:
    """A training that goes on iteration by iteration."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.env = make_gym_env(setting)
        n_inputs = self.env.single_observation_space.shape[0]
        n_actions = self.env.single_action_space.shape[0]
        self.agent = Agent(n_inputs, n_actions, setting.net_arch)
        self.low, self.high = self.env.action_space.low, self.env.action_space.high
        self.sample = th.compile(self.agent.sample, fullgraph=True, dynamic=False)
        self.parameters = {name: p.detach() for name, p in self.agent.named_parameters()}
        self.means = {name: th.zeros_like(p) for name, p in self.parameters.items()}
        self.squares = {name: th.zeros_like(p) for name, p in self.parameters.items()}
        self.n_updates = th.zeros(())
        self.descend = th.compile(self._descend, fullgraph=True, dynamic=False)
        shape = setting.n_steps, setting.n_envs
        self.observations, self.actions = th.empty(*shape, n_inputs), th.empty(*shape, n_actions)
        self.log_prob, self.values, self.rewards = (th.empty(shape) for _ in range(3))
        self.dones = np.empty(shape, dtype=np.float32)
        self.last = th.as_tensor(self.env.reset(seed=0)[0], dtype=th.float32)

    @th.no_grad()
    def iteration(self) -> None:
        """One rollout and its update."""
        self.roll_out()
        advantages, returns = self.advantages()
        everything = self.observations, self.actions, self.log_prob, advantages, returns
        flat = [x.flatten(0, 1) for x in everything]
        for _ in range(self.setting.n_epochs):
            order = th.randperm(len(flat[0]))
            parts = (x[order].chunk(self.setting.n_minibatches) for x in flat)
            for minibatch in zip(*parts, strict=True):
                self.descend(self.parameters, self.means, self.squares, self.n_updates, *minibatch)

    def roll_out(self) -> None:
        """Act in the environments."""
        noise = th.randn_like(self.actions)
        for step in range(self.setting.n_steps):
            sampled = self.sample(self.last, noise[step])
            self.observations[step] = self.last
            self.actions[step], self.log_prob[step], self.values[step] = sampled
            actions = np.clip(sampled[0].numpy(), self.low, self.high)
            observations, rewards, terminated, truncated, infos = self.env.step(actions)
            self.rewards[step] = th.as_tensor(rewards)
            self.dones[step] = terminated | truncated
            timed_out = np.flatnonzero(truncated & ~terminated)
            if timed_out.size:
                final = th.as_tensor(np.stack(infos["final_obs"][timed_out]), dtype=th.float32)
                values = self.agent.critic(final).flatten()
                self.rewards[step, th.as_tensor(timed_out)] += settings.GAMMA * values
            self.last = th.as_tensor(observations, dtype=th.float32)

    def advantages(self) -> tuple[th.Tensor, th.Tensor]:
        """Generalized advantages, and returns."""
        values, rewards = self.values.numpy(), self.rewards.numpy()
        following, advantage = self.agent.critic(self.last).flatten().numpy(), 0.0
        advantages = np.empty_like(values)
        for step in reversed(range(self.setting.n_steps)):
            goes_on = settings.GAMMA * (1 - self.dones[step])
            change = rewards[step] + goes_on * following - values[step]
            advantage = advantages[step] = change + goes_on * settings.GAE_LAMBDA * advantage
            following = values[step]
        return th.as_tensor(advantages), th.as_tensor(advantages + values)

    def _descend(
        self,
        parameters: Tensors,
        means: Tensors,
        squares: Tensors,
        n_updates: th.Tensor,
        *minibatch: th.Tensor,
    ) -> None:
        """A step of Adam with clipped gradients."""

        def loss(weights: Tensors) -> Any:
            return functional_call(self.agent, weights, minibatch)

        gradients = grad(loss)(parameters)
        norm = sum(g.square().sum() for g in gradients.values()) ** 0.5
        scale = (settings.MAX_GRAD_NORM / (norm + 1e-6)).clamp(max=1.0)
        n_updates += 1
        bias_1, bias_2 = 1 - BETA_1**n_updates, 1 - BETA_2**n_updates
        for name, gradient in gradients.items():
            clipped = scale * gradient
            mean = means[name].lerp_(clipped, 1 - BETA_1)
            square = squares[name].lerp_(clipped.square(), 1 - BETA_2)
            step = settings.LEARNING_RATE * (mean / bias_1) / ((square / bias_2).sqrt() + ADAM_EPS)
            parameters[name].sub_(step)


def make(setting: Setting) -> Callable[[], None]:
    """The PPO of this file."""
    return Training(setting).iteration
