"""The files that README.md and the documentation name are there."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\((?!https?://|#)([^)#\s]+)")
CODE = re.compile(r"`([^`\n]+)`")


def named_paths(page: Path) -> list[tuple[Path, str]]:
    """What a page links to, and what looks like a path from the root of the repository."""
    text = page.read_text(encoding="utf-8")
    tops = {entry.name for entry in ROOT.iterdir()}
    # A placeholder stands for a first example: seed-N.csv for seed-0.csv.
    named = [name.split("::")[0].replace("seed-N", "seed-0") for name in CODE.findall(text)]
    paths = [name for name in named if re.fullmatch(r"[\w.-]+(/[\w.+-]+)+/?", name)]
    from_root = [path for path in paths if path.split("/")[0] in tops]
    links = [(page.parent, link) for link in LINK.findall(text)]
    return [*links, *((ROOT, path) for path in from_root)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_names_are_tracked(page: Path) -> None:
    missing = [path for folder, path in named_paths(page) if not is_kept((folder / path).resolve())]
    assert not missing


def is_kept(path: Path) -> bool:
    """Whether git has it, or, outside a repository, whether it exists."""
    if not (ROOT / ".git").exists():
        return path.exists()
    command = ["git", "-C", str(ROOT), "ls-files", "--", str(path)]
    return bool(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
