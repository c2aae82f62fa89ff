"""How kernels are compiled."""

from typing import Any

import numpy as np
from numba import njit

from sb3_policyflow.kernels._numba.caching import KernelCache
from sb3_policyflow.kernels._numba.parts import PartCompiler

F = np.float32
ROWS = 64
"""Rows that are carried through a network together, see :mod:`~.tiles`.

Their activations must stay in a core's second-level cache. In place of 16, 64 takes 0.94 to 0.97 of
the time of a flow or of gradients with hidden layers [256, 128, 64], and 0.89 to 0.96 with [64, 64]
(Intel Xeon, family 6, model 167, one thread, 1024 and 6144 rows). No result depends on it.
"""

# Divisions by zero give infinity, as in torch, and threads may run beside each other.
_COMMON: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# Each way in takes time to compile.
_PART: dict[str, Any] = {
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": PartCompiler,
}
_EXACT: dict[str, Any] = {"fastmath": {"contract"}}
_SUMS: dict[str, Any] = {"fastmath": {"contract", "nsz", "reassoc"}}


def _compiler(**options: Any) -> Any:
    """A decorator for functions that numba compiles, and keeps for later processes."""

    def decorate(function: Any) -> Any:
        dispatcher = njit(**_COMMON, **options)(function)
        # What njit(cache=True) does, with another class of cache.
        dispatcher._cache = KernelCache(function)
        return dispatcher

    return decorate


kernel = _compiler(no_cfunc_wrapper=True, **_SUMS)
"""Called from Python."""
called = _compiler(no_cpython_wrapper=True, **_EXACT)
"""Called by kernels at its address."""
inner = njit(**_COMMON, **_PART, **_SUMS)
"""Part of a kernel; adds up in any order, as a BLAS does."""
exact = njit(**_COMMON, **_PART, **_EXACT)
"""Part of a kernel; computes as it is written, up to fused multiply-adds."""
