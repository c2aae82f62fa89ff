"""What kernels do for a policy as a whole."""

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import chain
from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN

from sb3_policyflow.flows.folding import has_hooks
from sb3_policyflow.kernels.critic import read_critic
from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.inspection import KernelView, have_hooks
from sb3_policyflow.kernels.threads import kernels_have_the_cores

OF_ACTOR_AND_CRITIC = (
    *("velocity.", "log_std", "latent_std"),
    *("mlp_extractor.value_net.", "value_net."),
)
"""How the names of their parameters and buffers begin, in a policy that kernels know."""

EXTRACTORS = (FlattenExtractor, NatureCNN, CombinedExtractor)
"""Features extractors that do the same work whatever they are given."""


def reason_kernels_are_off(policy: Any) -> str | None:
    """Why kernels work on a policy's networks only in part or not at all.

    :param policy: A policy whose ``velocity`` :func:`make_velocity_field` made, with SB3's critic.
    :return: A part of a sentence; None if they work on actor and critic.
    """
    return _why_unread(policy, "cpu")


def reason_graphs_are_off(policy: Any) -> str | None:
    """Why an update of a policy on a GPU is not recorded as a graph.

    :param policy: A policy as above.
    :return: A part of a sentence; None if it is.
    """
    if th.is_anomaly_enabled():
        return "torch looks for anomalies"
    if not type(policy).__module__.startswith("sb3_policyflow."):
        return f"{type(policy).__name__} is a policy of your own"
    if (reason := _why_unread(policy, "cuda")) is not None:
        return reason
    if have_hooks(policy.parameters()):
        return "parameters have hooks"
    extractors = policy.pi_features_extractor, policy.vf_features_extractor
    return next(filter(None, map(_why_unknown, extractors)), None)


def _why_unread(policy: Any, device: str) -> str | None:
    """Why a policy's actor and critic cannot be read on a device of this type."""
    if not isinstance(policy.velocity, KernelVelocityField):
        return f"{type(policy.velocity).__name__} is not a velocity field of kernels"
    actor = policy.velocity.parts(device)
    if isinstance(actor, str):
        return actor
    critic = KernelView(read_critic, device).of(policy)
    return f"for the critic, {critic}" if isinstance(critic, str) else None


def _why_unknown(extractor: Any) -> str | None:
    """Why it is not known what a features extractor does."""
    for module in extractor.modules():
        name = type(module).__name__
        if type(module) not in EXTRACTORS and not type(module).__module__.startswith("torch.nn."):
            return f"{name} is a features extractor of your own"
        if has_hooks(module):
            return f"{name} has hooks"
    return None


def reason_training_is_slow(policy: Any) -> str | None:
    """Why a policy trains without what makes it fast: kernels on a CPU, graphs on a GPU.

    :param policy: A policy as above.
    :return: A sentence; None if it has them.
    """
    if policy.device.type == "cuda":
        what, reason = "CUDA graphs are not used", reason_graphs_are_off(policy)
    else:
        what, reason = "The compiled kernels are off", reason_kernels_are_off(policy)
    return None if reason is None else f"{what}, and training is slower: {reason}."


def has_fixed_features(policy: Any) -> bool:
    """Whether kernels are on, and no step of an optimizer changes what actor and critic are given.

    :param policy: A policy as above.
    """
    if reason_kernels_are_off(policy) is not None:
        return False
    states = chain(policy.named_parameters(), policy.named_buffers())
    return all(name.startswith(OF_ACTOR_AND_CRITIC) for name, _ in states)


def shares_cores(train: Callable[[Any], None]) -> Callable[[Any], None]:
    """Give kernels torch's threads while an algorithm trains, if they do most of its work.

    :param train: The method of an algorithm, which has a ``policy``.
    """

    @functools.wraps(train)
    def wrapped(algorithm: Any) -> None:
        with _cores_for(algorithm.policy):
            train(algorithm)

    return wrapped


def _cores_for(policy: Any) -> AbstractContextManager[None]:
    """A block in which kernels have torch's threads, unless a features extractor needs them."""
    parameters = (p for name, p in policy.named_parameters() if "features_extractor" in name)
    torch_works = next(parameters, None) is not None or reason_kernels_are_off(policy) is not None
    return nullcontext() if torch_works else kernels_have_the_cores()
