"""The paper's exploration maps, by the command that makes them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("gymnasium_robotics")

from sb3_policyflow.benchmark.measure.visits import VisitMap
from sb3_policyflow.envs.point_maze import ENV_ID


@pytest.mark.slow
def test_command(tmp_path: Path) -> None:
    """Two seeds of two variants, hardly trained; a second call only draws."""
    command = [sys.executable, "-m", "sb3_policyflow.benchmark", "pointmaze", "--out", tmp_path]
    command += ["--variants", "b-ppo", "d-brownian", "--seeds", "0", "1", "--jobs", "2"]
    command += ["--steps", "2048", "--evaluations", "1", "--episodes", "1"]
    subprocess.run(command, check=True, capture_output=True)
    assert (tmp_path / "pointmaze.png").stat().st_size > 20_000
    table = (tmp_path / "pointmaze.md").read_text()
    assert "| (b) PPO | 2 |" in table
    assert "| (d) PolicyFlow, Brownian | 2 |" in table

    hyperparams = [
        json.loads((tmp_path / name / ENV_ID / "seed-0.json").read_text())["hyperparams"]
        for name in ("b-ppo", "d-brownian")
    ]
    assert "brownian_coef" not in hyperparams[0]
    assert float(hyperparams[1]["brownian_coef"]) > 0

    summaries = sorted(tmp_path.glob("*/*/seed-*.json"))
    assert len(summaries) == 4
    for summary in summaries:
        steps = json.loads(summary.read_text())["timesteps"]
        assert VisitMap.load(summary.with_suffix(".npz")).counts.sum() == steps == 2048

    made = [summary.stat().st_mtime_ns for summary in summaries]
    (tmp_path / "pointmaze.md").unlink()
    subprocess.run(command, check=True, capture_output=True)
    assert (tmp_path / "pointmaze.md").read_text() == table
    assert [summary.stat().st_mtime_ns for summary in summaries] == made
