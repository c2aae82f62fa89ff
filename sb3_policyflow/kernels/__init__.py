"""Compiled CPU kernels that equal PyTorch up to rounding, and fall back to it where they must.

On a GPU, CUDA graphs take their place: PyTorch's own operations, started together.

The rest of the package knows only what this module exports.

What they buy, measured against SB3's PPO, is on the documentation's page on speed.
"""

from typing import Any

from sb3_policyflow.flows import VelocityField
from sb3_policyflow.kernels.critic import KernelCritic
from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.gradients import clip_gradients_in_place, step_in_place
from sb3_policyflow.kernels.graphs import GraphMemory, Recording
from sb3_policyflow.kernels.inspection import are_in_mode, are_usable, has_values
from sb3_policyflow.kernels.layouts import LossOptions
from sb3_policyflow.kernels.losses import EvaluatedLoss, KernelLoss, LossInputs
from sb3_policyflow.kernels.policies import (
    has_fixed_features,
    reason_graphs_are_off,
    reason_kernels_are_off,
    reason_training_is_slow,
    shares_cores,
)

__all__ = [
    "EvaluatedLoss",
    "GraphMemory",
    "KernelCritic",
    "KernelLoss",
    "LossInputs",
    "LossOptions",
    "Recording",
    "are_in_mode",
    "are_usable",
    "clip_gradients_in_place",
    "has_fixed_features",
    "has_values",
    "make_velocity_field",
    "reason_graphs_are_off",
    "reason_kernels_are_off",
    "reason_training_is_slow",
    "shares_cores",
    "step_in_place",
]


def make_velocity_field(*args: Any, **kwargs: Any) -> VelocityField:
    """Make a :class:`~sb3_policyflow.flows.VelocityField` that kernels work on where they can.

    Takes the arguments of that class.
    """
    return KernelVelocityField(*args, **kwargs)
