"""Optuna search spaces, in the form that rl_zoo3 takes.

A study keeps only the raw values that a trial drew. ``sample_...`` draws them and returns the
hyperparameters; ``convert_flow_params`` turns the raw values into the same hyperparameters again.
"""

import functools
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from optuna import Trial
from torch import nn

from sb3_policyflow.flows.bounds import half_ranges

NET_ARCHS = {
    "tiny": [64],
    "small": [64, 64],
    "medium": [256, 256],
    "pyramid": [256, 128, 64],
}
ACTIVATIONS: dict[str, type[nn.Module]] = {
    "tanh": nn.Tanh,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "silu": nn.SiLU,
    "mish": nn.Mish,
}
RENAMED = {"path": "interpolant", "n_probes": "n_mc_samples", "probe_average": "mc_average"}
"""New names of options by those that studies of earlier versions have."""


class Task(NamedTuple):
    """What a search space depends on and rl_zoo3 does not hand on.

    ``n_timesteps`` are those of a trial, None if not known. ``action_scale`` is the mean half width
    of the dimensions of the action space that have bounds which mean something; 1 if none has.
    """

    n_timesteps: int | None = None
    action_scale: float = 1.0

    @classmethod
    def of(cls, n_timesteps: int, action_space: spaces.Space[Any]) -> "Task":
        """The task of trainings of some length with actions of this space."""
        if not isinstance(action_space, spaces.Box):
            return cls(n_timesteps)
        ranges = half_ranges(action_space.low, action_space.high)
        bounded = ranges[np.isfinite(ranges)]
        return cls(n_timesteps, float(bounded.mean()) if len(bounded) else 1.0)


UNKNOWN_TASK = Task()
TASK: ContextVar[Task] = ContextVar("TASK", default=UNKNOWN_TASK)
"""The task of the trial that is being drawn."""

MIN_UPDATES = 10
"""Rollouts are no longer than a trial has timesteps for so many, if it has for the shortest."""

Sampler = Callable[[Trial, int, int, dict[str, Any]], dict[str, Any]]
"""What rl_zoo3 calls: with the trial, the number of action dimensions, the number of environments
and what it has for other algorithms. It returns constructor arguments."""

SAMPLERS: dict[str, Sampler] = {}
"""The samplers of all algorithms, by the names of ``sb3_policyflow.algorithms``."""


def sampler(
    name: str, clip_ranges: Sequence[float] = (0.1, 0.2, 0.3)
) -> Callable[[Callable[[Trial], dict[str, Any]]], Sampler]:
    """Make a sampler of a function that draws what only its algorithm has.

    :param name: The algorithm's name.
    :param clip_ranges: Choices for its ``clip_range``.
    """

    def complete(suggest_own: Callable[[Trial], dict[str, Any]]) -> Sampler:
        @functools.wraps(suggest_own)
        def sample(
            trial: Trial,
            n_actions: int,  # noqa: ARG001
            n_envs: int,
            additional_args: dict[str, Any],  # noqa: ARG001
        ) -> dict[str, Any]:
            params = {
                **suggest_on_policy(trial, n_envs, clip_ranges),
                **suggest_network(trial),
                **suggest_own(trial),
            }
            return finish_sample(trial, params)

        SAMPLERS[name] = sample
        return sample

    return complete


@sampler("policyflow")
def sample_policyflow_params(trial: Trial) -> dict[str, Any]:
    """Draw hyperparameters of PolicyFlow.

    Latents are as wide as a share of the actions' range. They are the unit of the Brownian
    regularizer, whose weight therefore means the same for all tasks.
    """
    scale = TASK.get().action_scale
    params = {
        "ent_coef": trial.suggest_float("ent_coef", 1e-6, 0.03, log=True),
        "brownian_coef": trial.suggest_float("brownian_coef", 1e-4, 0.5, log=True),
        "interpolant": trial.suggest_categorical(
            "interpolant", ["rectified", "stochastic", "trigflow"]
        ),
        "n_flow_steps": trial.suggest_categorical("n_flow_steps", [4, 8, 12]),
        "solver": trial.suggest_categorical("solver", ["midpoint", "euler", "heun", "ab2"]),
        "log_std_init": trial.suggest_float("log_std_init", -2.5, 0.5),
    }
    if params["interpolant"] != "stochastic":
        params["latent_std"] = trial.suggest_float("latent_std", 0.1 * scale, scale, log=True)
    return params


@sampler("fpo", clip_ranges=(0.01, 0.03, 0.05, 0.1))
def sample_fpo_params(trial: Trial) -> dict[str, Any]:
    """Draw hyperparameters of FPO."""
    return {
        "n_mc_samples": trial.suggest_categorical("n_mc_samples", [4, 8, 16]),
        "mc_average": trial.suggest_categorical("mc_average", ["loss", "objective"]),
        "loss_target": trial.suggest_categorical("loss_target", ["epsilon", "velocity"]),
        "trust_region": trial.suggest_categorical("trust_region", ["ppo", "spo", "aspo"]),
        "difference_clamp": trial.suggest_categorical("difference_clamp", [3.0, 10.0]),
        "n_flow_steps": trial.suggest_categorical("n_flow_steps", [5, 10, 20]),
    }


@sampler("dppo")
def sample_dppo_params(trial: Trial) -> dict[str, Any]:
    """Draw hyperparameters of DPPO."""
    return {
        "process": trial.suggest_categorical("process", ["ddpm", "flow"]),
        "n_denoising_steps": trial.suggest_categorical("n_denoising_steps", [5, 10, 20]),
        "min_sampling_std": trial.suggest_float("min_sampling_std", 0.03, 0.3, log=True),
        "min_log_prob_std": trial.suggest_float("min_log_prob_std", 0.03, 0.3, log=True),
        "log_prob_reduction": trial.suggest_categorical("log_prob_reduction", ["mean", "sum"]),
        "denoising_gamma": trial.suggest_categorical("denoising_gamma", [0.9, 0.99, 1.0]),
        "n_critic_warmup": trial.suggest_categorical("n_critic_warmup", [0, 2, 5]),
    }


def suggest_on_policy(trial: Trial, n_envs: int, clip_ranges: Sequence[float]) -> dict[str, Any]:
    """Draw what every on-policy algorithm has, for rollouts that grow with ``n_envs``.

    The rollout has between 1024 and 32768 transitions, and at least 8 steps of each environment.
    Short trials have rollouts short enough for :data:`MIN_UPDATES` of them.
    """
    shortest = max(10, (n_envs - 1).bit_length() + 3)
    longest = max(15, shortest + 3)
    if (n_timesteps := TASK.get().n_timesteps) is not None:
        most = max(n_timesteps // MIN_UPDATES, 1).bit_length() - 1
        shortest = max((n_envs - 1).bit_length() + 3, min(shortest, most), 5)
        longest = max(shortest, min(longest, most))
    return {
        # A single value: it is drawn so that the study keeps it.
        "n_envs": trial.suggest_int("n_envs", n_envs, n_envs),
        "rollout_pow": trial.suggest_int("rollout_pow", shortest, longest),
        "n_minibatches_pow": trial.suggest_int("n_minibatches_pow", 2, min(6, shortest - 3)),
        "n_epochs": trial.suggest_categorical("n_epochs", [3, 5, 10, 20]),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-4, 0.1, log=True),
        "one_minus_gae_lambda": trial.suggest_float("one_minus_gae_lambda", 1e-3, 0.2, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True),
        "desired_kl": trial.suggest_categorical("desired_kl", [None, 0.005, 0.01, 0.02]),
        "clip_range": trial.suggest_categorical("clip_range", list(clip_ranges)),
        "max_grad_norm": trial.suggest_float("max_grad_norm", 0.3, 2.0),
    }


def suggest_network(trial: Trial) -> dict[str, Any]:
    """Draw the networks."""
    return {
        "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCHS)),
        "activation_fn": trial.suggest_categorical("activation_fn", list(ACTIVATIONS)),
        "embedding_dim": trial.suggest_categorical("embedding_dim", [16, 32, 64]),
    }


def finish_sample(trial: Trial, params: dict[str, Any]) -> dict[str, Any]:
    """Convert the raw values, and note the converted ones in the study."""
    hyperparams = convert_flow_params(params)
    # rl_zoo3 has made the environments by now, and passes the rest to the constructor.
    del hyperparams["n_envs"]
    for name in ("gamma", "gae_lambda", "n_steps", "batch_size"):
        trial.set_user_attr(name, hyperparams[name])
    return hyperparams


def convert_flow_params(params: dict[str, Any]) -> dict[str, Any]:
    """Turn the raw values of a trial of any flow algorithm into hyperparameters.

    Studies of earlier versions are read too, see :data:`RENAMED`.

    >>> raw = {"n_envs": 24, "rollout_pow": 11, "n_minibatches_pow": 6, "one_minus_gamma": 0.01,
    ...        "one_minus_gae_lambda": 0.05, "net_arch": "tiny", "activation_fn": "mish",
    ...        "embedding_dim": 16, "log_std_init": -1.0, "solver": "euler"}
    >>> hyperparams = convert_flow_params(raw)
    >>> hyperparams["n_steps"], hyperparams["batch_size"], hyperparams["solver"]
    (64, 24, 'euler')

    :param params: What the trial drew.
    :return: Hyperparameters as in a YAML file, ``n_envs`` included.
    """
    hyperparams = {RENAMED.get(name, name): value for name, value in params.items()}
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    hyperparams["gae_lambda"] = 1 - hyperparams.pop("one_minus_gae_lambda")
    hyperparams["n_steps"], hyperparams["batch_size"] = _sizes(
        hyperparams["n_envs"],
        2 ** hyperparams.pop("rollout_pow"),
        2 ** hyperparams.pop("n_minibatches_pow"),
    )
    policy_kwargs = {
        "net_arch": NET_ARCHS[hyperparams.pop("net_arch")],
        "activation_fn": ACTIVATIONS[hyperparams.pop("activation_fn")],
        "embedding_dim": hyperparams.pop("embedding_dim"),
    }
    for name in ("log_std_init", "latent_std"):
        if name in hyperparams:
            policy_kwargs[name] = hyperparams.pop(name)
    return {**hyperparams, "policy_kwargs": policy_kwargs}


def _sizes(n_envs: int, rollout: int, n_minibatches: int) -> tuple[int, int]:
    """``n_steps`` and ``batch_size`` for about this rollout, with minibatches of equal size."""
    # A power of two, so that a power of two divides the rollout whatever n_envs is.
    n_steps = 2 ** max((rollout // n_envs).bit_length() - 1, 0)
    transitions = n_steps * n_envs
    largest_power = transitions & -transitions
    return n_steps, transitions // min(n_minibatches, largest_power)
