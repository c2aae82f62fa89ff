"""Packages that only an extra of this package brings."""

import importlib

from gymnasium.error import DependencyNotInstalled


def import_extra(module: str, extra: str, env_id: str) -> None:
    """Import a module that only an extra of this package brings.

    :raises DependencyNotInstalled: if it is missing, or does not go with what else is installed;
        with the command that installs it
    """
    command = f"pip install 'sb3-policyflow[{extra}]'"
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise _broken(module, env_id, command, error) from error
        raise DependencyNotInstalled(f"{env_id} needs {module}: {command}") from error
    # What a package does when its dependencies' versions do not suit it is its own choice.
    except Exception as error:
        raise _broken(module, env_id, command, error) from error


def _broken(module: str, env_id: str, command: str, error: Exception) -> DependencyNotInstalled:
    first_line = next(iter(str(error).splitlines()), "")
    return DependencyNotInstalled(
        f"{env_id} needs {module}, which does not go with the packages installed here "
        f"({type(error).__name__}: {first_line}): {command} --upgrade"
    )
