"""The programs that the documentation shows."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


@pytest.mark.slow
def test_from_demonstrations_to_a_better_policy(tmp_path: Path) -> None:
    pytest.importorskip("tqdm")
    pytest.importorskip("rl_zoo3")
    command = [sys.executable, str(EXAMPLES / "imitation.py"), "64", "30", "4096"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("mean return") == 5
    assert (tmp_path / "cloned.zip").is_file()
