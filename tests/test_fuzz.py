"""A few dozen draws of ``tests/scripts/fuzz.py``, which draws thousands."""

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent / "scripts" / "fuzz.py"


@pytest.mark.slow
def test_every_draw_trains_or_is_refused_by_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(SCRIPT.parent)
    spec = importlib.util.spec_from_file_location("fuzz", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    fuzz = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fuzz)
    fuzz.make_check(n_draws=40, number=7)()
    assert fuzz.OUTCOMES["trained"] >= 20
    assert sum(fuzz.OUTCOMES.values()) > fuzz.OUTCOMES["trained"]
