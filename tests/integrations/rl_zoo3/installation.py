"""A wheel of this package, and virtual environments that have it installed."""

import os
import subprocess
import sys
import venv
from collections.abc import Sequence
from importlib.metadata import distribution
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).parents[3]


def build(target: str, folder: Path, source: Path = REPOSITORY) -> Path:
    """Build the package as a "wheel" or "editable" and return the file."""
    hook = "build_wheel" if target == "wheel" else "build_editable"
    script = f"import hatchling.build as b; print(b.{hook}({str(folder)!r}))"
    output = subprocess.run(
        [sys.executable, "-c", script], cwd=source, check=True, capture_output=True, text=True
    )
    return folder / output.stdout.split()[-1]


class Environment(NamedTuple):
    """A virtual environment that borrows every package but this one from the running Python."""

    folder: Path

    @classmethod
    def create(cls, folder: Path) -> "Environment":
        venv.create(folder, with_pip=False)
        environment = cls(folder)
        # The .pth files of a folder that is added in this way are not read.
        borrowed = [path for path in sys.path if Path(path).name.endswith("-packages")]
        environment.site_packages.joinpath("zz_borrowed.pth").write_text("\n".join(borrowed))
        return environment

    @property
    def python(self) -> str:
        return str(self.folder / "bin" / "python")

    @property
    def site_packages(self) -> Path:
        return next(self.folder.glob("lib/python*/site-packages"))

    def pip(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "pip", "--python", self.python, *arguments]
        subprocess.run(command, check=True, capture_output=True)

    def install(self, wheel: Path) -> "Environment":
        self.pip("install", "--no-deps", "--no-index", str(wheel))
        return self

    def start(
        self, arguments: Sequence[str], folder: Path, **variables: str
    ) -> "subprocess.Popen[str]":
        """Start this Python in a folder, with one thread for torch and without a display."""
        inherited = {key: os.environ[key] for key in ("PATH", "HOME") if key in os.environ}
        return subprocess.Popen(
            [self.python, *arguments],
            cwd=folder,
            env={**inherited, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, *arguments: str, folder: Path, status: int = 0, **variables: str) -> str:
        """Run this Python to its end, require its exit status, and return what it printed."""
        process = self.start(arguments, folder, **variables)
        output = process.communicate()[0]
        assert process.returncode == status, output
        return output


def console_script() -> str:
    """The ``rl_zoo3`` command of the running Python's rl_zoo3."""
    files = distribution("rl_zoo3").files or []
    return str(next(file.locate() for file in files if file.name == "rl_zoo3"))
