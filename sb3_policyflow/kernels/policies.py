"""What kernels do for a policy as a whole."""

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import chain
from typing import Any

from sb3_policyflow.kernels.critic import read_critic
from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.inspection import KernelView
from sb3_policyflow.kernels.threads import kernels_have_the_cores

OF_ACTOR_AND_CRITIC = (
    *("velocity.", "log_std", "latent_std"),
    *("mlp_extractor.value_net.", "value_net."),
)
"""How the names of their parameters and buffers begin, in a policy that kernels know."""


def reason_kernels_are_off(policy: Any) -> str | None:
    """Why kernels work on a policy's networks only in part or not at all.

    :param policy: A policy whose ``velocity`` :func:`make_velocity_field` made, with SB3's critic.
    :return: A part of a sentence; None if they work on actor and critic.
    """
    if not isinstance(policy.velocity, KernelVelocityField):
        return f"{type(policy.velocity).__name__} is not a velocity field of kernels"
    actor = policy.velocity.parts()
    if isinstance(actor, str):
        return actor
    critic = KernelView(read_critic).of(policy)
    return f"for the critic, {critic}" if isinstance(critic, str) else None


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
