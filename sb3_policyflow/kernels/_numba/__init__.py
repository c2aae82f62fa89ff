"""Kernels that numba compiles when they are first called, and keeps for later processes.

They take arrays of float32, read parameters where they are in memory, and carry few enough rows at
a time through a network to stay in the caches. Get them from
:func:`sb3_policyflow.kernels.compiler.load_kernels`.
"""

from sb3_policyflow.kernels._numba.activations import activation_address
from sb3_policyflow.kernels._numba.embedding import embed, embed_backward
from sb3_policyflow.kernels._numba.flow import flow
from sb3_policyflow.kernels._numba.losses import loss_gradients
from sb3_policyflow.kernels._numba.memory import adam, are_same, clip
from sb3_policyflow.kernels._numba.mlp import backward, forward

__all__ = [
    "activation_address",
    "adam",
    "are_same",
    "backward",
    "clip",
    "embed",
    "embed_backward",
    "flow",
    "forward",
    "loss_gradients",
]
