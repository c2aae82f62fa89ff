"""Which part of the package may import which: no arrow upwards, and three parts on the ground."""

import ast
from pathlib import Path

import pytest

import sb3_policyflow

ROOT = Path(sb3_policyflow.__file__).parent
ALGORITHMS = ("policyflow", "fpo", "dppo")
BELOW: dict[str, set[str]] = {
    "hints": set(),
    "envs": {"hints"},
    "flows": set(),
    "resilience": {"hints"},
    "kernels": {"flows"},
    "device": {"envs", "resilience"},
    "distributed": {"resilience"},
    "common": {"device", "distributed", "flows", "hints", "kernels", "resilience"},
    **{name: {"common", "flows", "kernels"} for name in ALGORITHMS},
    "algorithms": {"common", *ALGORITHMS},
    "callbacks": {"common", "flows", "policyflow", "resilience"},
    "export": {"common", "algorithms", "hints", "resilience"},
    "integrations": {
        "algorithms",
        "callbacks",
        "distributed",
        "envs",
        "flows",
        "hints",
        "imitation",
        "policyflow",
        "resilience",
    },
    "imitation": {"common", "envs", "flows", "hints", "resilience"},
    "benchmark": {
        "callbacks",
        "common",
        "envs",
        "export",
        "hints",
        "imitation",
        "integrations",
        "resilience",
        "__init__",
    },
}
"""What each folder or module of the package may import."""


def imports(path: Path) -> set[str]:
    """The folders and modules of the package that a file imports, also within functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == "sb3_policyflow":
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    ours = [name.split(".") for name in found if name.split(".")[0] == "sb3_policyflow"]
    parts = {(*names, "__init__")[1] for names in ours}
    return {part if part in BELOW else "__init__" for part in parts}


@pytest.mark.parametrize("part", BELOW)
def test_parts_import_only_what_is_below_them(part: str) -> None:
    folder = ROOT / part
    files = list(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
    assert files
    assert set().union(*map(imports, files)) <= BELOW[part] | {part}


def test_every_part_is_listed() -> None:
    modules = {path.stem for path in ROOT.glob("*.py")}
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert modules | folders == BELOW.keys() | {"__init__", "_moved"}
