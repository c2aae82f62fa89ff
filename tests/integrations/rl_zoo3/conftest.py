import importlib.util
from pathlib import Path

import pytest
from installation import Environment, build

NEEDED = ("rl_zoo3", "hatchling")
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if MISSING and here in item.path.parents:
            item.add_marker(pytest.mark.skip(reason=f"not installed: {', '.join(MISSING)}"))


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """An environment with the wheel, for tests that leave it as it is."""
    return Environment.create(tmp_path_factory.mktemp("installed")).install(wheel)


@pytest.fixture
def environment(wheel: Path, tmp_path: Path) -> Environment:
    """An environment of the test's own, with the wheel."""
    return Environment.create(tmp_path / "environment").install(wheel)
