"""What the wheel installs beside this package, for Python to run when it starts: docs/zoo.md."""


def install() -> None:
    """Put the finder in place, for interpreters that read no .pth files.

    Without its module, which an archive or a bundle may lack, rl_zoo3 runs without this package.
    """
    # Plain imports, which those who make bundles can see. In a checkout that is not installed, the
    # module is in this folder only.
    try:
        import sb3_policyflow_startup as startup
    except ImportError:
        try:
            from sb3_policyflow.integrations.rl_zoo3.startup import (
                sb3_policyflow_startup as startup,
            )
        except ImportError:
            return
    startup.install()
