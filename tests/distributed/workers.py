"""What the ranks do in the tests: each function is called by every rank."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.distributed.group import process_group
from sb3_policyflow.distributed.ranks import current
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback
from tests.helpers import digest, weights

SIZES: dict[str, Any] = {"n_steps": 16, "batch_size": 16, "n_epochs": 2, "seed": 0}
NETWORKS: dict[str, Any] = {"net_arch": [8], "embedding_dim": 8}


def model_of(env: Any, algorithm: type[Any] = PolicyFlow, **options: Any) -> Any:
    return algorithm("MlpPolicy", env, **{**SIZES, **options}, policy_kwargs=NETWORKS)


# Statistics


class Recording(gym.Env[Any, Any]):
    """Plays numbers that depend on its index and the step alone, of a scale of its own.

    :param index: Which environment it is, among those of all ranks.
    """

    def __init__(self, index: int) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.generator = np.random.default_rng(index)
        self.index = index
        self.steps = 0

    def _numbers(self) -> Any:
        return 1000.0 * self.index + (1.0 + self.index) * self.generator.normal(size=3)

    def reset(self, **_: Any) -> Any:
        return self._numbers(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self._numbers(), self.generator.normal(), self.steps % 7 == 0, False, {}


def recorded_statistics(n_envs: int) -> list[Any]:
    """Statistics of ``VecNormalize`` after three rollouts of so many environments in all."""
    ranks = current()
    n_own = n_envs // ranks.size
    indices = range(ranks.rank * n_own, (ranks.rank + 1) * n_own)
    makers = [lambda index=index: Recording(index) for index in indices]
    normalize = VecNormalize(DummyVecEnv(makers), gamma=0.9)  # type: ignore[arg-type]
    model_of(normalize).learn(3 * 16 * n_envs)
    return [(s.mean, s.var, s.count) for s in (normalize.obs_rms, normalize.ret_rms)]


# Gradients


def mean_gradients(layout: str) -> list[list[float]]:
    """The ranks' mean of a loss and of gradients, one of which may have another layout on rank 1.

    :param layout: "plain", "channels last on rank 1", "two types" or "half of the bits".
    """
    ranks = process_group()
    ranks.connect(th.device("cpu"))
    dtypes = {"two types": (th.float32, th.float64), "half of the bits": (th.bfloat16,) * 2}
    first, second = dtypes.get(layout, (th.float32, th.float32))
    shapes: Any = [((2, 3, 2, 2), first), ((), second), ((0,), first), ((3,), second)]
    parameters = [th.nn.Parameter(th.zeros(shape, dtype=dtype)) for shape, dtype in shapes]
    gradients = []
    for parameter in parameters:
        numbers = th.arange(parameter.numel(), dtype=parameter.dtype).view(parameter.shape)
        gradients.append((ranks.rank + 1) * numbers + 1)
    if ranks.rank == 1 and layout.startswith("channels last"):
        gradients[0] = gradients[0].to(memory_format=th.channels_last)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    loss = ranks.average_gradients(parameters, 10.0 ** (1 + ranks.rank))
    return [[loss], *(gradient.flatten().tolist() for gradient in gradients)]


# Faults


def run_with_fault(fault: str) -> tuple[str, float, bool]:
    """Learn until rank 1 fails, and go on living: the sentence, the time it took, finite weights.

    :param fault: "environment raises", "reward is NaN", "update raises", "loss is NaN", "killed".
    """
    model = model_of(make_vec_env("Pendulum-v1", 2), batch_size=24)
    callback = FaultCallback(fault) if current().rank == 1 else None
    began = time.monotonic()
    try:
        model.learn(1000, callback=callback)
    except (RuntimeError, ArithmeticError) as error:
        sentence = f"{type(error).__name__}: {error}"
        return sentence, time.monotonic() - began, bool(th.isfinite(weights(model)).all())
    return "no error", 0.0, True


class FaultCallback(BaseCallback):
    """Breaks something after the first rollout.

    :param fault: What to break.
    """

    def __init__(self, fault: str) -> None:
        super().__init__()
        self.fault = fault
        self.n_calls_of_net = 0

    def _on_step(self) -> bool:
        if self.n_calls == 20:
            if self.fault == "environment raises":
                raise RuntimeError("the simulator has crashed")
            if self.fault == "reward is NaN":
                self.locals["rewards"][0] = np.nan
        return True

    def _on_rollout_end(self) -> None:
        if self.n_calls > 16:
            net: Any = self.model.policy.value_net  # type: ignore[attr-defined]
            net.register_forward_hook(self._break)

    def _break(self, net: Any, inputs: Any, outputs: th.Tensor) -> th.Tensor | None:
        self.n_calls_of_net += 1
        if self.n_calls_of_net == 3:
            if self.fault == "update raises":
                raise RuntimeError("out of memory")
            if self.fault == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.fault == "loss is NaN":
                return outputs * th.nan
        return None


class StopCallback(BaseCallback):
    """Stops the training at a call."""

    def __init__(self, call: int) -> None:
        super().__init__()
        self.call = call

    def _on_step(self) -> bool:
        return self.n_calls < self.call


def run_until_stopped() -> tuple[int, int]:
    """Learn until a callback of rank 1 stops: the timesteps and the updates so far."""
    model = model_of(make_vec_env("Pendulum-v1", 2))
    model.learn(16 * 4 * 10, callback=StopCallback(25) if current().rank == 1 else None)
    return model.num_timesteps, model._n_updates


def _sentence(model: Any) -> str:
    try:
        model.learn(64)
    except ValueError as error:
        return str(error)
    return "no error"


def refused(different_envs: bool) -> str:
    """The sentence with which a run is refused that ranks cannot share."""
    n_envs = 2 + current().rank if different_envs else 2
    model = model_of(make_vec_env("Pendulum-v1", n_envs), batch_size=16 if different_envs else 15)
    return _sentence(model)


DIFFERENT: dict[str, Any] = {
    "clip_range": (0.1, 0.3),
    "clip_range_vf": (None, 0.2),
    "learning_rate": (lambda _: 1e-3, lambda remaining: 1e-3 * remaining),
    "n_flow_steps": (2, 3),
    "log_std_bounds": ((-2.0, 0.0), (-1.0, 0.0)),
    "lr_adaptation_kwargs": ({"factor": 1.2}, {"factor": 1.3}),
    "policy_kwargs": (
        {**NETWORKS, "activation_fn": nn.Tanh},
        {**NETWORKS, "activation_fn": nn.ELU},
    ),
}
"""What rank 0 and rank 1 are given, by option."""


def refused_option(name: str) -> str:
    """The sentence with which a run is refused whose ranks have other values of an option."""
    options = {**SIZES, "policy_kwargs": NETWORKS, name: DIFFERENT[name][current().rank]}
    return _sentence(PolicyFlow("MlpPolicy", make_vec_env("Pendulum-v1", 2), **options))


def run_alike() -> str:
    """Learn with options of which each process has objects of its own, which are alike."""
    kwargs = {**NETWORKS, "optimizer_kwargs": {"betas": (0.9, 0.99)}}
    kwargs["features_extractor_kwargs"] = {}
    options = {**SIZES, "policy_kwargs": kwargs, "clip_range": lambda remaining: 0.1 * remaining}
    return _sentence(PolicyFlow("MlpPolicy", make_vec_env("Pendulum-v1", 2), **options))


# Files


class StatesCallback(BaseCallback):
    """Keeps the environments' state of each rank where a checkpoint is written."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        inner: Any = self.training_env.unwrapped
        name = f"{self.model.num_timesteps}.{current().rank}"
        th.save(inner.get_state(), self.folder / name)


ALGORITHMS = {"PolicyFlow": PolicyFlow, "FPO": FPO, "DPPO": DPPO}


def each_algorithm(function: Callable[[Path, str], str], folder: Path) -> list[str]:
    """What a function returns for each of the algorithms."""
    results = []
    for name in ALGORITHMS:
        (folder / name).mkdir(exist_ok=True)
        results.append(function(folder / name, name))
    return results


def run_whole(folder: Path, algorithm: str) -> str:
    """Train without interruption, with a checkpoint after half of the time."""
    env = VecNormalize(MultiGoalVecEnv(2, seed=current().rank))
    model = model_of(env, ALGORITHMS[algorithm], desired_kl=0.01)
    saving = RolloutCheckpointCallback(33, str(folder), save_vecnormalize=True)
    model.learn(16 * 4 * 5, callback=[StatesCallback(folder), saving])
    return digest(model)


def resume(folder: Path, algorithm: str) -> str:
    """Go on from the checkpoint."""
    half = 16 * 4 * 3
    batch = MultiGoalVecEnv(2)
    batch.reset()
    batch.set_state(th.load(folder / f"{half}.{current().rank}", weights_only=False))
    env = VecNormalize.load(str(folder / f"rl_model_vecnormalize_{half}_steps.pkl"), batch)
    path = folder / f"rl_model_{half}_steps"
    model = ALGORITHMS[algorithm].load(path, env=env, force_reset=False)
    model.learn(model.remaining_timesteps, reset_num_timesteps=False)
    return digest(model)


def run_with_outputs(folder: Path) -> dict[str, Any]:
    """Train with all that writes, each rank with the same arguments."""
    model = model_of(make_vec_env("Pendulum-v1", 2), tensorboard_log=str(folder / "log"))
    calls = CountCallback()
    evaluation = EvalCallback(
        make_vec_env("Pendulum-v1", 1),
        eval_freq=16,
        n_eval_episodes=1,
        log_path=str(folder / "evaluations"),
        best_model_save_path=str(folder / "best"),
        verbose=0,
    )
    model.learn(16 * 4 * 14, callback=[evaluation, calls])
    model.save(folder / f"model_{current().rank}")
    return {
        "evaluations": evaluation.n_calls,
        "calls": calls.n_calls,
        "timesteps seen": calls.seen,
        "episodes": sorted(episode["r"] for episode in model.ep_info_buffer),
        "weights": weights(model),
    }


class CountCallback(BaseCallback):
    """Notes the timesteps that it sees."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def _on_step(self) -> bool:
        self.seen.append(self.num_timesteps)
        return True
