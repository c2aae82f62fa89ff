"""What the wheel installs beside this package, for Python to run when it starts: docs/zoo.md."""

import importlib
import importlib.util

_NAME = "sb3_policyflow_startup"
_IS_INSTALLED = importlib.util.find_spec(_NAME) is not None


def install() -> None:
    """Put the finder in place, for interpreters that read no .pth files."""
    # In a checkout that is not installed, the module is in this folder only.
    module = importlib.import_module(_NAME if _IS_INSTALLED else f"{__name__}.{_NAME}")
    module.install()
