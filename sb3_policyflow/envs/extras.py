"""Packages that only an extra of this package brings, and how to install them."""

import importlib

from gymnasium.error import DependencyNotInstalled

from sb3_policyflow.hints import install_command


def import_extra(module: str, extra: str, env_id: str) -> None:
    """Import a module that only an extra of this package brings.

    :param module: Name of the module.
    :param extra: Name of the extra.
    :param env_id: What needs it, for the error.
    :raises DependencyNotInstalled: If it is missing, or does not work with what else is installed;
        with the command that installs it.
    """
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise _broken(module, extra, env_id, error) from error
        message = f"{env_id} needs {module}: run `{install_command(extra)}`"
        raise DependencyNotInstalled(message) from error
    # A package may raise anything if the versions of its dependencies do not suit it.
    except Exception as error:
        raise _broken(module, extra, env_id, error) from error


def _broken(module: str, extra: str, env_id: str, error: Exception) -> DependencyNotInstalled:
    first_line = next(iter(str(error).splitlines()), "")
    return DependencyNotInstalled(
        f"{env_id} needs {module}, which does not work with the packages installed here "
        f"({type(error).__name__}: {first_line}): run "
        f"`{install_command(extra, upgrade=True)}`"
    )
