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
        from sb3_policyflow.kernels import _numba as module
    # Numba raises the second where there is no folder to keep what it compiles.
    except (ImportError, RuntimeError) as error:
        note_fallback(f"numba cannot be used ({error})")
        return None
    _forget_outdated(Path(module.flow.stats.cache_path))
    return module


@cache
def note_fallback(reason: str) -> None:
    """Tell who debugs, once, why plain torch does the work of a kernel."""
    logger.debug("Plain torch does the work of a fused kernel: %s.", reason)


def _forget_outdated(cache: Path) -> None:
    """Delete what was compiled before a kernel's source was changed.

    Numba looks at one file for each kernel, and kernels consist of parts from several.

    :param cache: Where compiled kernels are kept.
    """
    sources = (Path(__file__).parent / "_numba").glob("*.py")
    newest = max(source.stat().st_mtime for source in sources)
    for compiled in cache.glob("*.nb[ci]"):
        # Another process may delete it first.
        with suppress(OSError):
            if compiled.stat().st_mtime < newest:
                compiled.unlink()
