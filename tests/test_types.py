"""mypy's word is taken: `make types` runs it, and few lines are kept from it."""

import re
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "sb3_policyflow"


def test_few_lines_are_ignored_and_each_says_why() -> None:
    lines = [
        line
        for path in PACKAGE.rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if "type: ignore" in line
    ]
    assert 0 < len(lines) <= 5
    for line in lines:
        assert re.search(r"# type: ignore\[[a-z-]+\]  # \w+", line), line
