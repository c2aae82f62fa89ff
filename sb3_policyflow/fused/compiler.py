"""The kernels, where they can be had."""

import logging
from functools import cache
from types import ModuleType

logger = logging.getLogger(__name__)


@cache
def kernels() -> ModuleType | None:
    """The module of kernels, or None where numba cannot be imported.

    Imports numba when it is first called, never with the package.
    """
    try:
        from sb3_policyflow.fused import kernels as module
    except ImportError as error:
        note_fallback(f"numba cannot be imported ({error})")
        return None
    return module


@cache
def note_fallback(reason: str) -> None:
    """Tell who debugs, once, why plain torch does the work of a kernel."""
    logger.debug("Plain torch does the work of a fused kernel: %s.", reason)
