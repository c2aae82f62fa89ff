"""Training on prescribed rollouts, minibatches and draws, by one process or by several.

What a rollout holds, in which order its transitions come, and what is drawn for each is prescribed
for all environments together; each rank takes what belongs to its own. Nothing else is changed.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.buffers import FlowRolloutBuffer
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.tree import map_tensors
from sb3_policyflow.distributed import shared_memory
from tests.helpers import collect, weights

N_STEPS, N_ENVS, BATCH_SIZE, N_UPDATES = 16, 4, 16, 3
ARRAYS = ("observations", "actions", "values", "advantages", "returns")
ALGORITHMS: dict[str, type[Any]] = {"PolicyFlow": PolicyFlow, "FPO": FPO, "DPPO": DPPO}
OPTIONS: dict[str, dict[str, Any]] = {
    "clipped, adaptive": {"max_grad_norm": 0.1, "desired_kl": 0.01},
    "rollout, adaptive in minibatches": {
        "advantage_scope": "rollout",
        "desired_kl": 0.02,
        "lr_adaptation_kwargs": {"interval": "minibatch"},
    },
    "early stop": {"target_kl": 5e-3, "learning_rate": 1e-3, "clip_range_vf": 0.1},
}
CASES = [(algorithm, options, True) for algorithm in ALGORITHMS for options in OPTIONS]
CASES += [(algorithm, "clipped, adaptive", False) for algorithm in ALGORITHMS]
"""Algorithm, options, and whether in double precision; single is that of the kernels."""


class DoubleFeatures(FlattenExtractor):
    """The observations in double precision; SB3 makes them single."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations).double()


class DoubleBuffer(FlowRolloutBuffer):
    """Gives its samples in double precision, in which there are no kernels."""

    def samples(self) -> FlowRolloutBufferSamples:
        return map_tensors(lambda values: values.double(), super().samples())


def make_model(algorithm: type[Any], n_envs: int, double: bool = False, **options: Any) -> Any:
    """A model whose velocity is not zero at the start."""
    policy_kwargs: dict[str, Any] = {
        "initialization": "glorot",
        "net_arch": [16],
        "embedding_dim": 16,
    }
    if double:
        policy_kwargs["features_extractor_class"] = DoubleFeatures
        options["rollout_buffer_class"] = DoubleBuffer
    model = algorithm(
        "MlpPolicy",
        make_vec_env("Pendulum-v1", n_envs),
        n_steps=N_STEPS,
        batch_size=BATCH_SIZE,
        n_epochs=3,
        seed=1,
        policy_kwargs=policy_kwargs,
        **options,
    )
    if double:
        model.policy.double()
    return model


def make_rollouts(algorithm: str) -> list[dict[str, Any]]:
    """The arrays of as many rollouts as there are updates, (n_steps, n_envs, ...)."""
    model = make_model(ALGORITHMS[algorithm], N_ENVS)
    rollouts = []
    for _ in range(N_UPDATES):
        buffer = collect(model).rollout_buffer
        names = (*ARRAYS, *buffer.record_type._fields)
        rollouts.append({name: getattr(buffer, name).copy() for name in names})
    return rollouts


def trained(
    algorithm: str, options: str, double: bool, rollouts: list[dict[str, Any]], size: int
) -> dict[str, Any]:
    """What a model is after it has learned from prescribed rollouts.

    :param size: Ranks that train it.
    :return: The weights, and what may show that a decision was another one.
    """

    class Prescribed(ALGORITHMS[algorithm]):  # type: ignore[misc]
        def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
            complete = super().collect_rollouts(*args, **kwargs)
            first = self.rank * self.n_envs
            for name, values in rollouts[self.n_rollouts].items():
                getattr(self.rollout_buffer, name)[:] = values[:, first : first + self.n_envs]
            return complete

        def train(self) -> None:
            with prescribed_draws(self.n_rollouts, self.rank, size):
                super().train()

    Prescribed.__name__ = algorithm
    model = make_model(Prescribed, N_ENVS // size, double, **OPTIONS[options])
    model.learn(N_UPDATES * N_STEPS * N_ENVS)
    return {
        "weights": weights(model),
        "learning rate": model.adaptive_learning_rate or 0.0,
        "updates": model._n_updates,
        "timesteps": model.num_timesteps,
    }


@contextmanager
def prescribed_draws(seed: int, rank: int, size: int) -> Iterator[None]:
    """Draws and minibatches for all environments, of which this rank takes its own.

    Each minibatch has as many transitions of one environment as of another.
    """
    generator = np.random.RandomState(seed)
    n_envs = N_ENVS // size
    own = np.arange(rank * n_envs, (rank + 1) * n_envs)
    th.manual_seed(seed)

    def permutation(n: int) -> np.ndarray:
        assert n == n_envs * N_STEPS
        steps = np.stack([generator.permutation(N_STEPS) for _ in range(N_ENVS)], axis=1)
        shares = steps.reshape(-1, BATCH_SIZE // N_ENVS, N_ENVS)[:, :, own]
        # SB3 numbers transitions environment by environment.
        return (np.arange(n_envs) * N_STEPS + shares).ravel()

    def for_own(draw: Callable[..., th.Tensor]) -> Callable[..., th.Tensor]:
        def drawn(*args: Any, **kwargs: Any) -> th.Tensor:
            everything = [_for_all(arg, n_envs * N_STEPS) for arg in args]
            if everything == list(args):
                return draw(*args, **kwargs)
            values = draw(*everything, **kwargs)
            return values.unflatten(0, (N_STEPS, N_ENVS))[:, own].flatten(0, 1)

        return drawn

    draws = {name: for_own(getattr(th, name)) for name in ("rand", "randn", "randint")}
    with mock.patch("numpy.random.permutation", permutation), mock.patch.multiple(th, **draws):
        yield


def _for_all(size: Any, n_own: int) -> Any:
    """A size that begins with the number of transitions, for those of all ranks."""
    if isinstance(size, tuple):
        return tuple(_for_all(each, n_own) for each in size)
    return N_STEPS * N_ENVS if size == n_own else size


def train_all(rollouts: dict[str, list[dict[str, Any]]], size: int) -> dict[Any, Any]:
    """What comes of every case.

    :param rollouts: Those of each algorithm.
    :param size: Ranks that call this.
    """
    cases = [case for case in CASES if case[0] in rollouts]
    return {case: trained(*case, rollouts[case[0]], size) for case in cases}


def train_all_through_sockets(
    rollouts: dict[str, list[dict[str, Any]]], size: int
) -> dict[Any, Any]:
    """What comes of every case, as between machines, which share no memory."""
    shared_memory.FOLDER = Path("no such folder")
    return train_all(rollouts, size)
