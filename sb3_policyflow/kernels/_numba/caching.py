"""Where compiled kernels are kept, and until when."""

import hashlib
import logging
import pkgutil
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from typing import Any

from numba.core.caching import FunctionCache

logger = logging.getLogger(__name__)

PACKAGE = "sb3_policyflow.kernels"


class KernelCache(FunctionCache):
    """Numba's cache of a function, which a kernel can do without, and which knows all sources.

    Numba looks at one file for each function, and kernels consist of parts from several.

    :param function: The function that is compiled.
    :raises RuntimeError: If there is no folder for the cache, or no source file.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        file = self._cache_file
        file._source_stamp = (file._source_stamp, hash_of_sources())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was compiled, or None; a file that cannot be read is one that is missing."""
        try:
            found = super().load_overload(sig, target_context)
        except Exception as error:
            logger.debug("A compiled kernel cannot be read: %r.", error)
            with suppress(Exception):
                self.flush()
            found = None
        if found is None:
            _announce("Compiling the CPU kernels, once after an installation: about 10 seconds.")
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled if there is room for it."""
        try:
            super().save_overload(sig, data)
        except Exception as error:
            _announce(
                f"Compiled CPU kernels cannot be kept ({error}), and every process will compile "
                "them: name a folder in the environment variable NUMBA_CACHE_DIR."
            )


@cache
def _announce(what: str) -> None:
    """Say something once."""
    logger.warning(what)


@cache
def hash_of_sources() -> str:
    """A hash of all modules that kernels consist of, from wherever Python has loaded them.

    Times of files say less: some installers set them all to the same.
    """
    found = hashlib.sha256()
    for package in (PACKAGE, f"{PACKAGE}._numba"):
        spec = find_spec(package)
        folders = spec.submodule_search_locations if spec else []
        for _, name, _ in sorted(pkgutil.iter_modules(folders, f"{package}."), key=lambda m: m[1]):
            module = find_spec(name)
            loader: Any = None if module is None else module.loader
            # None where there is no source: then numba keeps nothing, or looks at the executable.
            source = loader.get_source(name) if hasattr(loader, "get_source") else None
            found.update(f"{name}\n{source}\n".encode())
    return found.hexdigest()
