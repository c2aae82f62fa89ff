"""Files that are written completely or not at all, and checked before they are used."""

import io
import json
import os
import uuid
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from stable_baselines3.common.save_util import open_path


def with_ending(path: str | Path, ending: str) -> Path:
    """The path, with an ending that its name may lack: what follows another dot is of the name.

    >>> [with_ending(name, ".zip").name for name in ("model", "noise0.3", "noise0.3.zip")]
    ['model.zip', 'noise0.3.zip', 'noise0.3.zip']

    :param path: A path as a user gives it.
    :param ending: The ending, with its dot.
    """
    return Path(path) if str(path).endswith(ending) else Path(f"{path}{ending}")


def saved_model(path: str | Path) -> Path:
    """The file of a saved model, whose name may be given without its ``.zip``.

    SB3 gives no ending to a name with a dot, so that the name may also be the whole.

    :param path: A path as a user gives it.
    :return: The file, which need not exist.
    """
    return Path(path) if Path(path).is_file() else with_ending(path, ".zip")


@contextmanager
def atomic_write(path: str | Path, suffix: str = "") -> Iterator[IO[bytes]]:
    """A file to write, which takes the place of ``path`` at the end of the block, or never.

    What is written goes to a temporary file in the same folder, reaches the disk, and is renamed:
    at every moment ``path`` is the old file or the new one. If the block raises, the temporary file
    is removed; if the process is killed, it stays behind as ``.NAME.*.tmp`` and can be deleted.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_write(Path(folder) / "a") as file:
    ...         _ = file.write(b"new")
    ...     (Path(folder) / "a").read_bytes()
    b'new'

    :param path: Where the file shall be. Folders that do not exist are created, with a warning.
    :param suffix: Added to a path that has none.
    """
    target = _target(Path(path), suffix)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")
    try:
        with open_path(temporary, "w") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename == str(temporary):
            error.filename = str(target)  # the name that the user knows
        raise
    _sync_folder(target.parent)


def _target(path: Path, suffix: str) -> Path:
    """The file itself, under the name that SB3 would give it."""
    if path.suffix == "" and suffix:
        path = Path(f"{path}.{suffix}")
    if path.is_dir():
        warnings.warn(f"Path '{path}' is a folder. Will save instead to {path}_2", stacklevel=5)
        path = Path(f"{path}_2")
    return Path(os.path.realpath(path))  # a link goes on pointing at the file


def _sync_folder(folder: Path) -> None:
    """Make a renaming durable, where the file system can do that for folders."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def opened(path: str | Path | io.BufferedIOBase, suffix: str) -> Iterator[Any]:
    """A file to read; one that the user has opened stays open."""
    file = open_path(path, "r", suffix=suffix)
    try:
        yield file
    finally:
        if isinstance(path, (str, Path)):
            file.close()


def check_archive(file: IO[bytes], path: Any, members: tuple[str, ...]) -> None:
    """Refuse what is not a whole archive with these members; the file is left at its start.

    :param file: The opened file.
    :param path: What the user calls it, for the message.
    :param members: Names that must be in the archive.
    :raises ValueError: If the file is truncated, damaged, or of another kind.
    """
    start = file.tell()
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
            missing = [name for name in members if name not in archive.namelist()]
    except zipfile.BadZipFile as error:
        raise ValueError(
            f"{path} is not a whole zip archive: it is truncated, damaged or another kind of file, "
            "so load an earlier checkpoint."
        ) from error
    if damaged or missing:
        what = f"its member {damaged!r} is damaged" if damaged else f"it lacks {missing}"
        raise ValueError(f"{path} does not hold a saved model, for {what}: load another file.")
    file.seek(start)


def saved_attributes(file: IO[bytes]) -> set[str]:
    """Names of the attributes in a saved model; the file is left at its start.

    :param file: The opened file, a whole archive.
    """
    start = file.tell()
    with zipfile.ZipFile(file) as archive:
        names = set(json.loads(archive.read("data")))
    file.seek(start)
    return names
