"""How kernels are compiled."""

from typing import Any

import numpy as np
from numba import njit

F = np.float32
ROWS = 16
"""Rows that are carried through a network together."""

# Divisions by zero give infinity, as in torch, and threads may run beside each other.
_COMMON: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
# What only kernels call needs no way in from Python, which takes time to compile.
_INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_EXACT: dict[str, Any] = {"fastmath": {"contract"}}
_SUMS: dict[str, Any] = {"fastmath": {"contract", "nsz", "reassoc"}}

kernel = njit(**_COMMON, **_SUMS)
"""Called from Python."""
inner = njit(**_COMMON, **_INNER, **_SUMS)
"""Called by kernels; adds up in any order, as a BLAS does."""
exact = njit(**_COMMON, **_INNER, **_EXACT)
"""Called by kernels; computes as it is written, up to fused multiply-adds."""
