"""Kernels that numba compiles when they are first called, and keeps for later processes.

They take arrays of float32, read parameters where they are in memory, and carry few enough rows at
a time through a network to stay in the caches. Get them from
:func:`sb3_policyflow.fused.compiler.kernels`.
"""

from sb3_policyflow.fused.kernels.embedding import embed, embed_backward
from sb3_policyflow.fused.kernels.flow import Method, Network, flow
from sb3_policyflow.fused.kernels.memory import clip, renew
from sb3_policyflow.fused.kernels.perceptron import backward, forward

__all__ = [
    "Method",
    "Network",
    "backward",
    "clip",
    "embed",
    "embed_backward",
    "flow",
    "forward",
    "renew",
]
