"""Lets rl_zoo3 find the algorithms of sb3_policyflow; docs/zoo.md explains it.

``sb3_policyflow.pth`` runs this when the interpreter starts. It imports only modules that are
loaded by then, and puts a finder on ``sys.meta_path``. SB3_POLICYFLOW_ZOO=0 in the environment
turns it off.
"""

import os
import sys

TYPE_CHECKING = False  # typing's own would cost an import
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any

WATCHED = ("rl_zoo3.utils", "rl_zoo3.hyperparams_opt", "rl_zoo3.exp_manager")


class ZooFinder:
    """Lets the other finders find a watched module, and registers after it has been executed."""

    def __init__(self) -> None:
        self._searching: set[str] = set()

    def find_spec(
        self, name: str, path: "Sequence[str] | None" = None, target: "ModuleType | None" = None
    ) -> "ModuleSpec | None":
        # Other packages' finders may ask all finders too, this one included: do not search twice.
        if name not in WATCHED or name in self._searching:
            return None
        self._searching.add(name)
        try:
            spec = self._ask_others(name, path, target)
        finally:
            self._searching.discard(name)
        if spec is not None:
            _register_after(spec, name)
        return spec

    def _ask_others(
        self, name: str, path: "Sequence[str] | None", target: "ModuleType | None"
    ) -> "ModuleSpec | None":
        for finder in sys.meta_path:
            if finder is not self and hasattr(finder, "find_spec"):
                spec = finder.find_spec(name, path, target)
                if spec is not None:
                    return spec
        return None


def install() -> None:
    """Put the finder in place, once, and register with modules of rl_zoo3 that are loaded."""
    if os.environ.get("SB3_POLICYFLOW_ZOO") == "0":
        return
    # This module is in the package and beside it: compare names, so that one finder is installed.
    if not any(type(finder).__name__ == ZooFinder.__name__ for finder in sys.meta_path):
        sys.meta_path.insert(0, ZooFinder())
    for name in WATCHED:
        if name in sys.modules and not _is_running(sys.modules[name]):
            _register(name)


def _is_running(module: "ModuleType") -> bool:
    return getattr(module.__spec__, "_initializing", False)


def _register_after(spec: "ModuleSpec", name: str) -> None:
    """Have the loader register once it has executed the module of this name."""
    try:
        loader: Any = spec.loader
        execute = loader.exec_module

        def exec_module(module: "ModuleType") -> None:
            execute(module)
            # Some loaders, such as zipimport's, serve many modules.
            if module.__name__ == name:
                _register(name)

        loader.exec_module = exec_module
    except Exception as error:
        _warn(name, error)


def _register(name: str) -> None:
    """Register with a module of rl_zoo3; an error becomes a warning, so that rl_zoo3 works."""
    try:
        from sb3_policyflow.integrations.rl_zoo3.registration import register

        register(sys.modules[name])
    except Exception as error:
        _warn(name, error)


def _warn(name: str, error: Exception) -> None:
    import warnings

    warnings.warn(
        f"sb3_policyflow could not register with {name}, so rl_zoo3 runs without its algorithms "
        f"and environments ({type(error).__name__}: {error}). Reinstall sb3-policyflow, or set "
        "SB3_POLICYFLOW_ZOO=0 to do without.",
        RuntimeWarning,
        stacklevel=2,
    )
