"""Timings of environments: what is counted, and what is said of ids that there are not."""

import json
import statistics
from pathlib import Path

import pytest

from sb3_policyflow.benchmark.__main__ import main
from sb3_policyflow.benchmark.speed import environments


def test_each_environment_and_size_is_timed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "speed.json"
    ids = ["MultiGoal-v0", "Pendulum-v1"]
    options = ["--num-envs", "2", "16", "--seconds", "0.05", "--out", str(path)]
    assert main(["environments", *ids, *options]) == 0
    figures = json.loads(path.read_text())
    timings = figures["timings"]
    assert [(t["env_id"], t["num_envs"]) for t in timings] == [(i, n) for i in ids for n in (2, 16)]
    for timing in timings:
        assert len(timing["rounds"]) == environments.N_ROUNDS
        assert timing["steps_per_second"] == statistics.median(timing["rounds"])
    assert figures["machine"]["cores"] >= 1
    header, _, *rows, said = capsys.readouterr().out.strip().splitlines()
    assert said == f"Wrote {path}."
    assert header.startswith("| steps per second | 2 | 16 |")
    for row, row_id in zip(rows, ids, strict=True):
        cells = row.strip("| ").split(" | ")
        assert cells[0] == row_id
        found = [t for t in timings if t["env_id"] == row_id]
        rates = [(t["steps_per_second"], t["steps_per_cpu_second"]) for t in found]
        assert cells[1:3] == [f"{wall:,.0f} ({cpu:,.0f})" for wall, cpu in rates]


def test_steps_are_those_of_all_environments() -> None:
    class Env:
        num_envs = 7
        calls = 0

        def step(self, _: object) -> None:
            self.calls += 1

    env = Env()
    steps, seconds = environments._steps_in(env, None, 0.01)  # type: ignore[arg-type]
    assert steps == 7 * env.calls > 0
    assert seconds >= 0.01


@pytest.mark.parametrize("env_id", ["MultiGoal-v9", "Playground/CheetaRun-v0"])
def test_an_unknown_id_is_said_in_one_sentence(
    env_id: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["environments", env_id]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert any(hint in line for hint in ("MultiGoal-v0", "MultiGoal`", "CheetahRun", "playground"))
