"""Compiled CPU kernels that equal PyTorch up to rounding, and fall back to it where they must.

The rest of the package knows only what this module exports.
"""

from typing import Any

from sb3_policyflow.flows import VelocityField
from sb3_policyflow.kernels.critic import KernelCritic, reason_kernels_are_off
from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.gradients import clip_gradients_in_place

__all__ = [
    "KernelCritic",
    "clip_gradients_in_place",
    "make_velocity_field",
    "reason_kernels_are_off",
]


def make_velocity_field(*args: Any, **kwargs: Any) -> VelocityField:
    """Make a :class:`~sb3_policyflow.flows.VelocityField` that kernels work on where they can.

    Takes the arguments of that class.
    """
    return KernelVelocityField(*args, **kwargs)
