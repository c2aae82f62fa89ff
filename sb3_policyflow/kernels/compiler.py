"""The kernels, where they can be had."""

import importlib
import logging
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

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
        module: Any = importlib.import_module("sb3_policyflow.kernels._numba")
    # Numba raises the second where there is no folder to keep what it compiles.
    except (ImportError, RuntimeError) as error:
        return f"numba cannot be used ({error})"
    _delete_outdated(Path(module.flow.stats.cache_path))
    kernels: Kernels = module
    return kernels


@cache
def note_fallback(reason: str) -> None:
    """Tell who debugs, once for each reason, why plain torch does the work of a kernel."""
    logger.debug("Plain torch does the work of a kernel: %s.", reason)


def _delete_outdated(cache: Path) -> None:
    """Delete what was compiled before a kernel's source was changed.

    Numba looks at one file for each kernel, and kernels consist of parts from several.

    :param cache: Where compiled kernels are kept.
    """
    sources = Path(__file__).parent.rglob("*.py")
    newest = max(source.stat().st_mtime for source in sources)
    for compiled in cache.glob("*.nb[ci]"):
        # Another process may delete it first.
        with suppress(OSError):
            if compiled.stat().st_mtime < newest:
                compiled.unlink()
