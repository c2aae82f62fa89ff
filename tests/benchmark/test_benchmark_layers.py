"""Which part of the benchmark may import which."""

import ast
from pathlib import Path

import pytest

import sb3_policyflow.benchmark

ROOT = Path(sb3_policyflow.benchmark.__file__).parent
MAY_IMPORT = {
    "measure": set(),
    "report": {"measure", "results"},
    "figures": {"errors", "measure", "report", "results"},
    "speed": {"errors", "measure", "report"},
}
"""By folder, other modules and folders of the benchmark; commands are above all of these."""


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_folders_import_only_what_is_below_them(folder: str) -> None:
    imported = {
        node.module.split(".")[2]
        for path in (ROOT / folder).glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        and node.module
        and node.module.startswith("sb3_policyflow.benchmark.")
    }
    assert imported <= MAY_IMPORT[folder] | {folder}
