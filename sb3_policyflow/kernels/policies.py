"""What kernels do for a policy as a whole."""

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from sb3_policyflow.kernels.critic import read_critic
from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.inspection import KernelView
from sb3_policyflow.kernels.threads import kernels_have_the_cores


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


def learns_features(policy: Any) -> bool:
    """Whether the features extractors of a policy have parameters.

    :param policy: A policy of SB3.
    """
    return any("features_extractor" in name for name, _ in policy.named_parameters())


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
    torch_works = learns_features(policy) or reason_kernels_are_off(policy) is not None
    return nullcontext() if torch_works else kernels_have_the_cores()
