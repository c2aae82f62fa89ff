"""The kernels, where they can be had."""

import logging
import os
from functools import cache
from typing import cast

from sb3_policyflow.kernels.layouts import Kernels

logger = logging.getLogger(__name__)

SWITCH = "SB3_POLICYFLOW_KERNELS"
"""Environment variable that turns the kernels off if it is 0."""


@cache
def load_kernels() -> Kernels | str:
    """The kernels, or the reason why there are none.

    Imports numba when it is first called, never with the package.
    """
    if os.environ.get(SWITCH) == "0":
        return f"{SWITCH} is 0"
    try:
        from sb3_policyflow.kernels import _numba
    # Numba may be broken in many ways, and raises RuntimeError where there is no source file, or no
    # folder to keep what it compiles. To compile in each process would take it some ten seconds.
    except Exception as error:
        return (
            f"numba cannot be used ({error}); if it has no folder for what it compiles, name one "
            "in the environment variable NUMBA_CACHE_DIR"
        )
    return cast("Kernels", _numba)


@cache
def note_fallback(reason: str) -> None:
    """Tell who debugs, once for each reason, why plain torch does the work of a kernel."""
    logger.debug("Plain torch does the work of a kernel: %s.", reason)
