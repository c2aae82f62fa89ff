"""rl_zoo3's commands, run where the wheel was installed, from an empty directory."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from installation import Environment, console_script

MULTIGOAL = ["--algo", "policyflow", "--env", "MultiGoal-v0"]
QUICK = ["-params", "n_steps:2", "batch_size:2048", "n_epochs:1", "n_flow_steps:2"]
TRAIN = ["-m", "rl_zoo3.train"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def trained(installed: Environment, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder that two short runs on MultiGoal left, and the output of the second.

    The second may open 256 files, far fewer than it has environments.
    """
    folder = tmp_path_factory.mktemp("empty")
    options = [*MULTIGOAL, "-n", "65536", "--eval-freq", "22000", "--save-freq", "22000"]
    options += ["--eval-episodes", "2", *QUICK, "brownian_coef:'lin_0.25_0.05'"]
    installed.run(*TRAIN, *options, folder=folder)
    limited = (
        "import resource, runpy\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))\n"
        "runpy.run_module('rl_zoo3.train', run_name='__main__')"
    )
    return folder, installed.run("-c", limited, *options, folder=folder)


def test_train_says_what_it_trains(trained: tuple[Path, str]) -> None:
    output = trained[1]
    assert "========== MultiGoal-v0 ==========" in output
    assert re.search(r"hyperparameters from: .*sb3_policyflow/hyperparams/policyflow\.yml", output)
    assert "('n_envs', 1024)" in output
    assert "('brownian_coef', 'lin_0.25_0.05')" in output
    assert "Using 1024 environments" in output
    assert "brownian_loss" in output
    assert "Saving to logs/policyflow/MultiGoal-v0_2" in output


def test_one_monitor_file_has_the_episodes_of_all_environments(trained: tuple[Path, str]) -> None:
    files = list((trained[0] / "logs/policyflow/MultiGoal-v0_2").glob("*.monitor.csv"))
    assert len(files) == 1
    with files[0].open() as file:
        header = file.readline()
        rows = list(csv.DictReader(file))
    assert '"env_id": "MultiGoal-v0"' in header
    # 64 steps of 1024 environments: each has ended an episode, of at most 50 steps.
    assert len(rows) >= 1024
    assert max(int(row["l"]) for row in rows) == 50


@pytest.mark.parametrize(
    ("option", "model"),
    [
        ([], "MultiGoal-v0.zip"),
        (["--load-best"], "best_model.zip"),
        (["--load-last-checkpoint"], "rl_model_64512_steps.zip"),
    ],
)
def test_enjoy(
    installed: Environment, trained: tuple[Path, str], option: list[str], model: str
) -> None:
    options = [*MULTIGOAL, "-f", "logs", "--no-render", "-n", "120", *option]
    output = installed.run("-m", "rl_zoo3.enjoy", *options, folder=trained[0])
    assert f"Loading logs/policyflow/MultiGoal-v0_2/{model}" in output
    assert re.search(r"Mean reward: [\d.]+ \+/- [\d.]+", output)
    assert "Success rate" in output


def test_training_continues_from_a_model(installed: Environment, trained: tuple[Path, str]) -> None:
    agent = ["-i", "logs/policyflow/MultiGoal-v0_1/MultiGoal-v0.zip", "-f", "continued"]
    options = [*MULTIGOAL, "-n", "4096", *agent, "--eval-freq", "-1", *QUICK]
    output = installed.run(*TRAIN, *options, folder=trained[0])
    assert "Loading pretrained agent" in output
    # 32 updates of one epoch made the agent, two more follow; the last one logged is the first.
    assert re.search(r"n_updates +\| 33 ", output)


def test_record_video_in_colors_of_the_environment(
    installed: Environment, trained: tuple[Path, str]
) -> None:
    options = [*MULTIGOAL, "-f", "logs", "-n", "40", "--exp-id", "1"]
    installed.run("-m", "rl_zoo3.record_video", *options, folder=trained[0])
    [video] = (trained[0] / "logs/policyflow/MultiGoal-v0_1/videos").glob("*.mp4")
    imageio = pytest.importorskip("imageio.v3", reason="imageio is not installed")
    frames = imageio.imread(video, plugin="FFMPEG")
    assert len(frames) >= 40
    assert frames[0].std() > 1  # not one color
    assert np.abs(frames[-1].astype(float) - frames[0]).max() > 50  # something moves


def test_console_script_trains_and_plots(installed: Environment, trained: tuple[Path, str]) -> None:
    folder, script = trained[0], console_script()
    options = ["-n", "256", "--eval-freq", "-1", "-params", "n_steps:16", "batch_size:64"]
    train = ["train", "--algo", "policyflow", "--env", "Pendulum-v1", "-f", "script", *options]
    assert "Saving to script/policyflow/Pendulum-v1_1" in installed.run(
        script, *train, folder=folder
    )
    selection = ["-a", "policyflow", "-e", "MultiGoal-v0", "-f", "logs"]
    installed.run(script, "plot_train", *selection, folder=folder)
    table = installed.run(
        script, "all_plots", *selection, "--no-million", "-o", "data", folder=folder
    )
    assert "POLICYFLOW" in table
    assert "MultiGoal-v0" in table
    installed.run(script, "plot_from_file", "-i", "data.pkl", "-o", "figure.png", folder=folder)
    assert (folder / "figure.png").stat().st_size > 1000


def test_mujoco(installed: Environment, tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    options = ["--env", "HalfCheetah-v5", "-n", "128", "--eval-freq", "-1"]
    quick = ["-params", "n_steps:16", "batch_size:64", "n_epochs:1"]
    output = installed.run(*TRAIN, "--algo", "policyflow", *options, *quick, folder=tmp_path)
    assert "========== HalfCheetah-v5 ==========" in output
    assert "('desired_kl', 0.01)" in output
    assert "Normalization activated: {'gamma': 0.98}" in output
    assert "Saving to logs/policyflow/HalfCheetah-v5_1" in output


@pytest.mark.parametrize(
    "env_id", ["PointMaze_Medium_Diverse_GDense-v3", "PointMazeMultiGoal-Medium-v0"]
)
def test_mazes(installed: Environment, tmp_path: Path, env_id: str) -> None:
    pytest.importorskip("gymnasium_robotics")
    which = ["--algo", "policyflow", "--env", env_id]
    output = installed.run(*TRAIN, *which, "-n", "2048", "--eval-freq", "-1", folder=tmp_path)
    assert "Using 32 environments" in output
    options = ["-f", "logs", "--no-render", "-n", "650"]
    output = installed.run("-m", "rl_zoo3.enjoy", *which, *options, folder=tmp_path)
    assert f"Loading logs/policyflow/{env_id}_1/{env_id}.zip" in output
    assert re.search(r"Mean reward: \d+\.\d+ ", output)


def test_ppo_of_sb3_runs_on_multigoal(installed: Environment, tmp_path: Path) -> None:
    options = ["--env", "MultiGoal-v0", "-n", "2048", "--eval-freq", "-1"]
    quick = ["-params", "n_steps:2", "batch_size:2048", "n_epochs:1"]
    output = installed.run(*TRAIN, "--algo", "ppo", *options, *quick, folder=tmp_path)
    assert re.search(r"hyperparameters from: .*sb3_policyflow/hyperparams/ppo\.yml", output)
    assert len(list(tmp_path.glob("logs/ppo/MultiGoal-v0_1/*.monitor.csv"))) == 1


@pytest.mark.parametrize("algo", ["fpo", "dppo"])
def test_rivals_train_and_are_enjoyed(installed: Environment, tmp_path: Path, algo: str) -> None:
    which = ["--algo", algo, "--env", "Pendulum-v1"]
    output = installed.run(*TRAIN, *which, "-n", "4096", "--eval-freq", "-1", folder=tmp_path)
    assert re.search(rf"hyperparameters from: .*sb3_policyflow/hyperparams/{algo}\.yml", output)
    assert f"Saving to logs/{algo}/Pendulum-v1_1" in output
    options = ["-f", "logs", "--no-render", "-n", "400"]
    output = installed.run("-m", "rl_zoo3.enjoy", *which, *options, folder=tmp_path)
    assert f"Loading logs/{algo}/Pendulum-v1_1/Pendulum-v1.zip" in output
    assert re.search(r"Mean reward: -[\d.]+ ", output)


def test_optimize_in_one_command(installed: Environment, tmp_path: Path) -> None:
    options = ["--env", "Pendulum-v1", "--optimize", "--n-trials", "2", "-n", "2000"]
    options += ["--eval-episodes", "1", "--sampler", "random", "--seed", "218", "--no-optim-plots"]
    options += ["--storage", "sqlite:///study.db", "--study-name", "s"]
    output = installed.run(*TRAIN, "--algo", "policyflow", *options, folder=tmp_path)
    assert "Number of finished trials:  2" in output
    for name in ("brownian_coef", "n_flow_steps", "solver", "interpolant", "embedding_dim"):
        assert re.search(rf"^    {name}: ", output, re.MULTILINE)
