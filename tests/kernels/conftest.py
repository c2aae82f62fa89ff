"""Plain counterparts of what kernels do."""

from collections.abc import Iterator

import pytest

from sb3_policyflow.kernels.compiler import SWITCH, load_kernels, note_fallback


@pytest.fixture
def no_kernels(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Turn the kernels off."""
    monkeypatch.setenv(SWITCH, "0")
    load_kernels.cache_clear()
    note_fallback.cache_clear()
    yield
    monkeypatch.undo()
    load_kernels.cache_clear()
    note_fallback.cache_clear()
