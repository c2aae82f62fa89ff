"""Neither source files, nor a cache, nor a disk that can be written are needed to act and learn."""

import compileall
import errno
import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from numba.core import caching

import sb3_policyflow
from sb3_policyflow.kernels._numba import caching as ours

PACKAGE = Path(sb3_policyflow.__file__).parent
HYPERPARAMS = PACKAGE.parent / "hyperparams"
USE = """
import logging, sys, warnings
logging.getLogger("sb3_policyflow").setLevel(logging.DEBUG)
logging.basicConfig()
warnings.simplefilter("ignore")
import numpy as np
import sb3_policyflow
from sb3_policyflow import PolicyFlow
from sb3_policyflow.kernels import reason_kernels_are_off
from sb3_policyflow.integrations.rl_zoo3.experiment import choose_config
model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=64, batch_size=64, n_epochs=1, seed=0)
print(model.predict(np.zeros(3, np.float32), deterministic=True)[0])
{more}
print(sb3_policyflow.__file__)
print(reason_kernels_are_off(model.policy))
with open(choose_config("policyflow", "MultiGoal-v0", "none.yml")) as file:
    print(len(file.read()))
"""


def use(path: Path, more: str = "model.learn(64)", **environment: str) -> tuple[list[str], str]:
    """What a process that has the package from a path prints and logs."""
    done = subprocess.run(
        [sys.executable, "-c", USE.format(more=more)],
        capture_output=True,
        text=True,
        cwd=path.parent,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(path), **environment},
    )
    assert done.returncode == 0, done.stderr
    action, file, reason, size, end = done.stdout.split("\n")
    assert abs(float(action.strip("[]"))) < 0.4  # an untrained policy's
    assert file.startswith(str(path))
    assert int(size) == len((HYPERPARAMS / "policyflow.yml").read_text(encoding="utf-8"))
    assert end == ""
    return [file, reason], done.stderr


@pytest.fixture
def no_home(tmp_path: Path) -> dict[str, str]:
    """An environment in which there is nowhere to keep anything: root may write everywhere else."""
    file = tmp_path / "file"
    file.touch()
    places = ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
    return {**dict.fromkeys(places, str(file)), "PYTHONDONTWRITEBYTECODE": "1"}


def copy_package(folder: Path) -> Path:
    """A folder with the package as a wheel installs it, but without its module for startup."""
    pattern = shutil.ignore_patterns("__pycache__", "sb3_policyflow_startup.py")
    shutil.copytree(PACKAGE, folder / "sb3_policyflow", ignore=pattern)
    shutil.copytree(HYPERPARAMS, folder / "sb3_policyflow" / "hyperparams")
    return folder


HASH = "from sb3_policyflow.kernels._numba.caching import hash_of_sources; print(hash_of_sources())"


@pytest.mark.slow
def test_imported_from_an_archive(tmp_path: Path, no_home: dict[str, str]) -> None:
    """Kernels work there, and what they cannot keep, they do without."""
    tree = copy_package(tmp_path / "tree")
    archive = tmp_path / "package.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for source in tree.rglob("*.*"):
            file.write(source, source.relative_to(tree))
    (_, reason), messages = use(archive, more="", **no_home)
    assert reason == "None"
    assert "Compiled CPU kernels cannot be kept" in messages


@pytest.mark.slow
def test_archives_know_when_a_source_has_changed(tmp_path: Path) -> None:
    """From wherever the sources come, and whatever the times of the files are."""

    def found(path: Path) -> str:
        environment = {**os.environ, "PYTHONPATH": str(path)}
        command = [sys.executable, "-W", "ignore", "-c", HASH]
        return subprocess.check_output(command, env=environment, cwd=tmp_path, text=True)

    tree = copy_package(tmp_path / "tree")
    archive = shutil.make_archive(str(tmp_path / "package"), "zip", tree)
    first = found(tree)
    assert first == ours.hash_of_sources() + "\n" == found(Path(archive))
    helper = tree / "sb3_policyflow/kernels/_numba/matrices.py"
    times = helper.stat().st_atime_ns, helper.stat().st_mtime_ns
    helper.write_text(helper.read_text() + "# other\n")
    os.utime(helper, ns=times)
    assert found(tree) != first


@pytest.mark.slow
def test_compiled_modules_without_their_sources(tmp_path: Path, no_home: dict[str, str]) -> None:
    tree = copy_package(tmp_path / "tree")
    assert compileall.compile_dir(tree, quiet=2, legacy=True)
    for source in tree.rglob("*.py"):
        source.unlink()
    (file, reason), _ = use(tree, **no_home)
    assert file.endswith(".pyc")
    assert reason.startswith("numba cannot be used (cannot cache function")
    assert reason.endswith("name one in the environment variable NUMBA_CACHE_DIR")


@pytest.mark.slow
def test_a_disk_that_cannot_be_written(tmp_path: Path, no_home: dict[str, str]) -> None:
    # Its own folder would be the next place, which root can always write.
    only = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    (_, reason), _ = use(copy_package(tmp_path / "tree"), **no_home, **only)
    assert "NUMBA_CACHE_DIR" in reason


KERNEL = """
from sb3_policyflow.kernels._numba.options import kernel

@kernel
def double(x):
    return 2 * x
"""


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """A function that loads a kernel as a new process would."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    path = tmp_path / "little.py"
    path.write_text(KERNEL)

    def load() -> Any:
        spec = importlib.util.spec_from_file_location("little", path)
        assert spec is not None
        assert spec.loader is not None
        module: ModuleType = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        kernel = module.double  # type: ignore[attr-defined]
        assert kernel(2.0) == 4.0
        return kernel

    return load


def n_loaded(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def test_kernels_are_kept_until_a_source_changes(
    load: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [n_loaded(load()), n_loaded(load())] == [0, 1]
    monkeypatch.setattr(ours, "hash_of_sources", lambda: "other")
    assert [n_loaded(load()), n_loaded(load())] == [0, 1]


def test_compiling_is_announced_once_and_only_where_nothing_is_kept(
    load: Callable[[], Any], caplog: pytest.LogCaptureFixture
) -> None:
    said = []
    for _ in range(2):  # as in two processes, of which the second finds what the first compiled
        ours._announce.cache_clear()
        load()
        said.append([message for message in caplog.messages if "Compiling" in message])
        caplog.clear()
    assert said == [
        ["Compiling the CPU kernels, once after an installation: about 10 seconds."],
        [],
    ]


@pytest.mark.parametrize("pattern", ["*.nbi", "*.nbc"])
@pytest.mark.parametrize("rest", [b"", b"broken", b"\x80\x05"])
def test_files_that_cannot_be_read_are_made_again(
    load: Callable[[], Any], tmp_path: Path, pattern: str, rest: bytes
) -> None:
    """A power failure or a full disk has left them so."""
    load()
    [file] = (tmp_path / "cache").rglob(pattern)
    file.write_bytes(rest)
    assert n_loaded(load()) == 0
    assert n_loaded(load()) == 1


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_disk_that_becomes_full_costs_the_cache_alone(
    load: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def fail(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(caching.IndexDataCacheFile, "_save_index", fail)
    assert [n_loaded(load()), n_loaded(load())] == [0, 0]


IMPORT = """
import sys, warnings
sys.modules["sb3_policyflow_startup"] = None
sys.modules["sb3_policyflow.integrations.rl_zoo3.startup.sb3_policyflow_startup"] = None
import sb3_policyflow
"""


@pytest.mark.slow
def test_the_package_is_imported_without_its_module_for_startup() -> None:
    subprocess.run([sys.executable, "-c", IMPORT], check=True)


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("integrations/rl_zoo3/startup/__init__.py", "import sb3_policyflow_startup"),
        ("kernels/compiler.py", "from sb3_policyflow.kernels import _numba"),
    ],
)
def test_bundlers_can_see_what_is_imported_late(module: str, imported: str) -> None:
    """They look for statements, and leave out what a computed name stands for."""
    source = (PACKAGE / module).read_text(encoding="utf-8")
    assert imported in source
    assert "import_module" not in source
