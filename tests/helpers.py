"""What the tests share: small runs, and a model's numbers to compare."""

import hashlib
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.resilience.saving import RandomStates

SMALL: dict[str, Any] = {"n_steps": 16, "batch_size": 8, "n_epochs": 1, "seed": 0}
"""Options of the smallest run that has two minibatches."""
TWO_EPOCHS: dict[str, Any] = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "seed": 0}
"""Options of a run in which the second epoch finds a policy that has changed."""
TINY: dict[str, Any] = {"net_arch": [8], "embedding_dim": 8}
"""``policy_kwargs`` of the smallest networks."""


def weights(model: Any) -> th.Tensor:
    """All that a model's policy is made of, in one vector of float64, shape (n,).

    :param model: A model; its buffers count too, such as the statistics of a ``BatchNorm``.
    """
    return th.cat([value.flatten().double() for value in model.policy.state_dict().values()])


def assert_trained(model: Any, before: th.Tensor) -> None:
    """Assert that learning has changed the weights, and left every one of them finite.

    :param model: The model.
    :param before: Its :func:`weights` before it learned.
    """
    after = weights(model)
    assert th.isfinite(after).all()
    assert not th.equal(after, before)


def train(model: Any, total_timesteps: int, **options: Any) -> Any:
    """Let a model learn, and assert that it did: see :func:`assert_trained`.

    :param model: The model.
    :param total_timesteps: For how long.
    :param options: Other arguments of its ``learn``.
    :return: The model.
    """
    before = weights(model)
    model.learn(total_timesteps, **options)
    assert_trained(model, before)
    return model


def learned(module: nn.Module) -> list[nn.Parameter]:
    """The parameters of a module that are learned: all but the frequencies of time embeddings.

    :param module: A policy or a part of it.
    """
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


def perturb(module: nn.Module, scale: float) -> None:
    """Add noise to all parameters, as an update might.

    :param module: A policy or a part of it.
    :param scale: Standard deviation of the noise.
    """
    with th.no_grad():
        for parameter in learned(module):
            parameter += scale * th.randn_like(parameter)


def collect(model: Any) -> Any:
    """Fill a model's rollout buffer, and learn nothing from it.

    :param model: The model.
    :return: The model.
    """
    total_timesteps = model.n_steps * model.n_envs
    # SB3 starts an environment in ``learn`` alone.
    _, callback = model._setup_learn(total_timesteps, reset_num_timesteps=False)
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    return model


def collected(algorithm: type[Any], **options: Any) -> tuple[Any, FlowRolloutBufferSamples]:
    """A model whose velocity is not zero, and a rollout of the policy that it now has.

    :param algorithm: Its class.
    :param options: Options of the model, whose rollouts have 64 samples.
    :return: The model, in evaluation mode, and the rollout.
    """
    sizes = {"n_steps": 64, "batch_size": 16, "n_epochs": 1, "seed": 0}
    policy_kwargs = {"initialization": "glorot"}
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, **sizes, **options)
    collect(model.learn(64))
    model.policy.set_training_mode(False)
    return model, model.rollout_buffer.samples()


def n_updates(model: Any) -> int:
    """How many epochs a model has gone through, by its log."""
    return int(model.logger.name_to_value["train/n_updates"])


def last_observations(model: Any) -> Any:
    """The observations that the next rollout starts with; None if it resets the environment."""
    return model._last_obs


def digest(model: Any) -> str:
    """A hash of all that the rest of a training depends on, and of what is drawn next.

    :param model: A model in a ``VecNormalize``.
    """
    statistics = model.get_vec_normalize_env()
    optimizer = model.policy.optimizer.state_dict()["state"]
    states = RandomStates.now(model.device)
    arrays = [
        *model.policy.state_dict().values(),
        *(value for state in optimizer.values() for value in state.values()),
        *(statistics.obs_rms.mean, statistics.obs_rms.var, statistics.ret_rms.var),
        *(statistics.returns, last_observations(model)),
        *(states.torch, states.numpy["state"]["key"]),
    ]
    numbers = model._n_updates, model.num_timesteps, model.adaptive_learning_rate, states.python
    sha = hashlib.sha256(repr(numbers).encode())
    for array in arrays:
        sha.update(np.asarray(array).tobytes())
    return sha.hexdigest()


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """A block that ends in time, or fails."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    former = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


class TwoWays(gym.Env[Any, Any]):
    """Only actions other than 0 are rewarded."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(1, np.float32), float(abs(action[0]) > 0.2), True, False, {}
