"""The kernels, where they can be had."""

import logging
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType

logger = logging.getLogger(__name__)


SWITCH = "SB3_POLICYFLOW_KERNELS"
"""Environment variable that turns the kernels off if it is 0."""


@cache
def kernels() -> ModuleType | None:
    """The package of kernels, or None where numba cannot be imported or kernels are turned off.

    Imports numba when it is first called, never with the package.
    """
    if os.environ.get(SWITCH) == "0":
        note_fallback(f"{SWITCH} is 0")
        return None
    try:
        _forget_outdated()
        from sb3_policyflow.fused import kernels as module
    except ImportError as error:
        note_fallback(f"numba cannot be imported ({error})")
        return None
    return module


@cache
def note_fallback(reason: str) -> None:
    """Tell who debugs, once, why plain torch does the work of a kernel."""
    logger.debug("Plain torch does the work of a fused kernel: %s.", reason)


def _forget_outdated() -> None:
    """Delete what was compiled before a kernel's source was changed.

    Numba looks at one file for each kernel, and kernels consist of parts from several.
    """
    folder = Path(__file__).parent / "kernels"
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for compiled in folder.glob("__pycache__/*.nb[ci]"):
        # Another process may delete it first.
        with suppress(OSError):
            if compiled.stat().st_mtime < newest:
                compiled.unlink()
