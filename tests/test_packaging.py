"""The source archive has all that belongs to it, and makes the same wheel as the checkout."""

import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
pytest.importorskip("hatchling")

pytestmark = pytest.mark.slow


def build(kind: str, source: Path, folder: Path) -> Path:
    script = f"import hatchling.build as b; print(b.build_{kind}({str(folder)!r}))"
    command = [sys.executable, "-c", script]
    output = subprocess.run(command, cwd=source, check=True, capture_output=True, text=True).stdout
    return folder / output.split()[-1]


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


def names_in(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_the_source_archive_has_every_tracked_file(sdist: Path) -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {name for name in listed.stdout.splitlines() if (ROOT / name).exists()}
    assert tracked - packed == set()
    assert not {name for name in packed if "__pycache__" in name or name.startswith("demo")}


def test_the_source_archive_makes_the_wheel_of_the_checkout(sdist: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    [source] = tmp_path.iterdir()
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    ours, theirs = build("wheel", ROOT, first), build("wheel", source, second)
    assert names_in(ours) == names_in(theirs)
    assert {"sb3_policyflow/py.typed", "sb3_policyflow.pth"} <= names_in(ours)
    hyperparams = {name for name in names_in(ours) if name.endswith(".yml")}
    assert len(hyperparams) == len(list((ROOT / "hyperparams").glob("*.yml")))
    pytest.importorskip("twine")
    command = [sys.executable, "-m", "twine", "check", "--strict", str(sdist), str(ours)]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout


def test_extras_bring_what_their_commands_import() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    names = {
        extra: {re.split(r"[\[<>=]", requirement)[0] for requirement in requirements}
        for extra, requirements in extras.items()
    }
    assert {"tensorboard", "rl-zoo3"} <= names["zoo"]
    assert names["onnx"] == {"onnx", "onnxscript"}
    assert names["browser"] == {"playwright"}
    assert names["plots"] == {"matplotlib", "rliable", "pandas"}
    assert list(PROJECT["project"]["urls"]) == ["Repository"]
