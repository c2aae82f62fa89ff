"""What `make demo` says while it trains, and what it leaves when it is interrupted."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("matplotlib")

from sb3_policyflow import PolicyFlow

pytestmark = pytest.mark.slow


def start(folder: Path, steps: int) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "sb3_policyflow.benchmark", "demo"]
    return subprocess.Popen(
        [*command, "--steps", str(steps), "--out", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def test_it_shows_returns_and_ends_quietly_with_the_model_kept(tmp_path: Path) -> None:
    demo = start(tmp_path, 14_000_000)
    assert demo.stdout is not None
    said = ""
    while "step/s, return" not in said:  # the first update may compile
        said += demo.stdout.read(1)
        assert demo.poll() is None, said
    time.sleep(0.5)
    demo.send_signal(signal.SIGINT)
    rest = demo.communicate(timeout=120)[0]
    assert demo.returncode == 130, rest
    assert "Traceback" not in rest
    assert "Exception ignored" not in rest
    assert rest.splitlines()[-1].endswith(f"Kept: {tmp_path / 'model.zip'}.")
    assert PolicyFlow.load(tmp_path / "model").num_timesteps > 0


def test_it_reports_the_goals_and_what_it_wrote(tmp_path: Path) -> None:
    demo = start(tmp_path, 60_000)
    said = demo.communicate(timeout=300)[0]
    assert demo.returncode == 0, said
    assert "goals reached" in said
    for name in ("model.zip", "trajectories.png", "learning_curve.png"):
        assert str(tmp_path / name) in said
        assert (tmp_path / name).stat().st_size > 1000
