"""The learning curve of one training."""

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor

pytest.importorskip("pandas")

from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.benchmark.figures.progress import progress_figure
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv


def test_progress_figure_of_a_real_run(tmp_path: Path) -> None:
    env = VecMonitor(MultiGoalVecEnv(4, seed=0))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, device="cpu")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * 64 * 5)
    [axes] = progress_figure(tmp_path / "progress.csv").get_axes()
    [line] = axes.get_lines()
    np.testing.assert_array_equal(line.get_xdata(), 256 * np.arange(1, 6))
    last = np.mean([episode["r"] for episode in model.ep_info_buffer or ()])
    assert line.get_ydata()[-1] == pytest.approx(last, abs=1e-4)


def test_progress_without_a_finished_episode_is_refused(tmp_path: Path) -> None:
    (tmp_path / "progress.csv").write_text("time/total_timesteps\n50\n")
    with pytest.raises(BenchmarkError, match="no finished episode"):
        progress_figure(tmp_path / "progress.csv")
