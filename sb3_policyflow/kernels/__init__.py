"""Compiled CPU kernels that equal PyTorch up to rounding, and fall back to it where they must.

The rest of the package knows only what this module exports.

What they buy: one iteration of PolicyFlow on MultiGoal (1024 environments, 24 steps, 5 epochs,
hidden layers [256, 128, 64], Mish) as a multiple of PPO's, without and with some of the kernels;
in brackets ``train()`` alone. Medians, in turn and in one process, on an Intel Xeon, family 6,
model 167, two cores; PPO took 1.70, 0.96 and 1.09 s.

=============================================  ===========  ==================  ===========
kernels for                                    one thread   two threads         passive
=============================================  ===========  ==================  ===========
nothing                                        2.22 (1.41)  2.19 (1.44)         2.56 (1.44)
acting (``integrate``)                         1.58 (1.41)  1.64 (1.44)         1.55 (1.44)
acting, gradients of actor and critic          0.85 (0.63)  1.37 (1.15)         0.92 (0.76)
=============================================  ===========  ==================  ===========

"Passive" is two threads with ``OMP_WAIT_POLICY=passive`` in the environment, see
:mod:`~sb3_policyflow.kernels.threads`.
"""

from typing import Any

from sb3_policyflow.flows import VelocityField
from sb3_policyflow.kernels.critic import KernelCritic
from sb3_policyflow.kernels.fields import KernelVelocityField
from sb3_policyflow.kernels.gradients import clip_gradients_in_place, step_in_place
from sb3_policyflow.kernels.inspection import has_values
from sb3_policyflow.kernels.layouts import LossOptions
from sb3_policyflow.kernels.losses import KernelLoss, LossInputs
from sb3_policyflow.kernels.policies import reason_kernels_are_off, shares_cores

__all__ = [
    "KernelCritic",
    "KernelLoss",
    "LossInputs",
    "LossOptions",
    "clip_gradients_in_place",
    "has_values",
    "make_velocity_field",
    "reason_kernels_are_off",
    "shares_cores",
    "step_in_place",
]


def make_velocity_field(*args: Any, **kwargs: Any) -> VelocityField:
    """Make a :class:`~sb3_policyflow.flows.VelocityField` that kernels work on where they can.

    Takes the arguments of that class.
    """
    return KernelVelocityField(*args, **kwargs)
