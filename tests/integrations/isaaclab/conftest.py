from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest
from fakes import FAKES, forget_isaaclab


@pytest.fixture
def installed(
    version: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[None]:
    """Make one version importable in this process, for the length of a test."""
    registry = dict(gym.registry)
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, FAKES / "common", *([FAKES / version] if version else [])):
        monkeypatch.syspath_prepend(folder)
    yield
    gym.registry.clear()
    gym.registry.update(registry)
    forget_isaaclab()
