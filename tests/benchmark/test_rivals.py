"""Rivals take turns, each in a process of its own, and one that is not there is named."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_policyflow.benchmark.__main__ import main
from sb3_policyflow.benchmark.speed.rivals.pendulum import EPISODE_STEPS, PendulumVectorEnv
from sb3_policyflow.benchmark.speed.rivals.process import Iteration
from sb3_policyflow.benchmark.speed.rivals.summary import summarize

TINY = ["speed", "rivals", "--settings", "tiny", "--threads", "1", "--repetitions", "2"]


@pytest.mark.slow
def test_rivals_take_turns_and_a_missing_one_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "speed.json"
    kept = {"setting": "tiny", "threads": 8}
    out.write_text(json.dumps({"runs": [{"setting": "tiny", "threads": 1}, kept]}))
    nowhere = str(tmp_path / "python")
    names = ["policyflow", "sbx"]
    options = ["--rivals", *names, "--python", f"sbx={nowhere}", "--out", str(out)]
    assert main([*TINY, *options]) == 0
    run, other = json.loads(out.read_text())["runs"]
    assert other == kept
    assert list(run["rivals"]) == ["ppo", "policyflow"]
    for figures in run["rivals"].values():
        assert len(figures["iterations"]) == 2
        assert all(one["seconds"] > 0 for one in figures["iterations"])
        expected = figures["seconds"] / run["rivals"]["ppo"]["seconds"]
        assert figures["ratio"] == pytest.approx(expected)
    assert nowhere in run["left_out"]["sbx"]
    table = capsys.readouterr().out
    assert "| SB3's PPO |" in table
    assert "**1.00**" in table
    assert "sbx is left out" in table


def test_nothing_is_measured_without_the_reference(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*TINY, "--rivals", "ppo", "--python", "/nowhere/python"]) == 2
    assert "SB3's PPO does not train" in capsys.readouterr().err


def test_the_first_iterations_do_not_count() -> None:
    taken = {"ppo": [9.0, 9.0, 2.0, 3.0, 100.0], "sbx": [30.0, 9.0, 6.0, 1.0, 7.0]}
    iterations = {name: [Iteration(t, t / 2, None) for t in taken[name]] for name in taken}
    figures = summarize(iterations)["sbx"]
    assert (figures["seconds"], figures["cpu_seconds"]) == (6.0, 3.0)
    assert (figures["first_seconds"], figures["ratio"]) == (30.0, 2.0)
    assert [one["seconds"] for one in figures["iterations"]] == [6.0, 1.0, 7.0]


def test_pendulums_are_gymnasiums() -> None:
    n_envs = 5
    batch = PendulumVectorEnv(n_envs)
    batch.reset(seed=0)
    single = gym.make("Pendulum-v1").unwrapped
    single.reset()
    rng = np.random.default_rng(0)
    for _ in range(20):
        states = np.stack([batch.angle, batch.speed], axis=1)
        actions = rng.uniform(-3, 3, (n_envs, 1)).astype(np.float32)
        observations, rewards, terminated, truncated, _ = batch.step(actions)
        assert not (terminated | truncated).any()
        for i in range(n_envs):
            single.state = states[i]  # type: ignore[attr-defined]
            observation, reward, *_ = single.step(actions[i])
            np.testing.assert_allclose(observations[i], observation, atol=1e-6)
            assert rewards[i] == pytest.approx(reward)


def test_pendulums_end_at_different_steps() -> None:
    env = PendulumVectorEnv(3)
    env.reset(seed=0)
    ends = []
    for step in range(EPISODE_STEPS):
        before = env.angle.copy(), env.speed.copy()
        observations, _, _, truncated, infos = env.step(np.zeros((3, 1), dtype=np.float32))
        for i in np.flatnonzero(truncated):
            ends.append((step, i))
            assert infos["final_obs"][i].shape == (3,)
            assert not np.allclose(infos["final_obs"][i], observations[i])
            assert np.isfinite(before).all()
    assert ends == [(EPISODE_STEPS - 3, 2), (EPISODE_STEPS - 2, 1), (EPISODE_STEPS - 1, 0)]
