"""What the paper map points at is there."""

import ast
import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAP = (ROOT / "docs" / "paper_map.md").read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`([^`\n]+)`", MAP)))


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("sb3_policyflow.")])
def test_code_exists(name: str) -> None:
    pkgutil.resolve_name(name)


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("tests/")])
def test_tests_exist(name: str) -> None:
    path, _, function = name.partition("::")
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    tests = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
    assert not function or function in tests


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("hyperparams/")])
def test_files_exist(name: str) -> None:
    assert (ROOT / name).is_file()


def test_every_equation_is_there_and_has_a_test_or_a_reason() -> None:
    table = MAP.partition("## Equations")[2].partition("## Algorithm")[0]
    found: list[int] = []
    for numbers, code, test in re.findall(r"^\| (\d[^|]*) \|[^|]*\| (.*) \|(.*)\|$", table, re.M):
        ends = [int(number) for number in re.findall(r"\d+", numbers)]
        found += range(ends[0], ends[-1] + 1) if "to" in numbers else ends
        assert "tests/" in test or code.startswith(("none: ", "as ("))
    assert sorted(found) == list(range(1, 36))
