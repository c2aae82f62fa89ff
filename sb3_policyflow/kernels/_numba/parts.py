"""Functions that only kernels call, which become code as parts of these alone.

Numba optimizes a function, makes machine code of it, and then optimizes a copy of it again in each
function that calls it, and so on up to the kernel. For a part none of this is of use.
"""

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class Part(JITCodeLibrary):
    """What numba has instead of machine code for a part: LLVM's code, for others to take over."""

    def finalize(self) -> None:
        """Take over the parts that this one calls."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:  # noqa: ARG002
        """There is no way in: 0."""
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> Any:
        """Itself, which numba tells where a function's globals are."""
        return self

    def set_env(self, env_name: str, env: Any) -> None:
        """Parts have no globals that Python looks after: numba makes constants of them."""


class PartCompiler(Compiler):
    """Compiles a function to a :class:`Part`."""

    def __init__(self, typing: Any, target: Any, library: Any, *others: Any) -> None:
        super().__init__(typing, target, library or Part(target.codegen(), "part"), *others)
