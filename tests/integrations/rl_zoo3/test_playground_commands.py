"""rl_zoo3's commands on tasks of MuJoCo Playground. `make test-playground` runs these."""

import re
from pathlib import Path

import pytest
from installation import Environment

pytest.importorskip("mujoco_playground", reason="playground is not installed")

pytestmark = pytest.mark.slow

ENV_ID = "Playground/CartpoleBalance-v0"
TRAIN = ["-m", "rl_zoo3.train", "--algo", "policyflow"]
QUICK = ["-params", "n_envs:32", "n_steps:8", "batch_size:128", "n_epochs:1"]


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What has every process use what others have compiled."""
    return {"JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled"))}


@pytest.fixture(scope="module")
def trained(
    installed: Environment, compiled: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """The folder of a run with an evaluation, and its output."""
    folder = tmp_path_factory.mktemp("playground")
    options = ["--env", ENV_ID, "-n", "512", "--eval-freq", "256", "--eval-episodes", "2"]
    return folder, installed.run(*TRAIN, *options, *QUICK, folder=folder, **compiled)


def test_train(trained: tuple[Path, str]) -> None:
    folder, output = trained
    assert f"========== {ENV_ID} ==========" in output
    assert re.search(r"hyperparameters from: .*sb3_policyflow/hyperparams/policyflow\.yml", output)
    assert "('max_grad_norm', 0.5)" in output  # this task's
    assert "Using 32 environments" in output
    assert "Episode length: 1000.00 +/- 0.00" in output
    assert "Saving to logs/policyflow/Playground-CartpoleBalance-v0_1" in output
    [monitor] = folder.glob("logs/policyflow/*/*.monitor.csv")
    assert f'"env_id": "{ENV_ID}"' in monitor.read_text()


@pytest.mark.parametrize("option", [[], ["--load-best"]])
def test_enjoy(
    installed: Environment,
    compiled: dict[str, str],
    trained: tuple[Path, str],
    option: list[str],
) -> None:
    options = ["--algo", "policyflow", "--env", ENV_ID, "-f", "logs", "--no-render", "-n", "1000"]
    output = installed.run("-m", "rl_zoo3.enjoy", *options, *option, folder=trained[0], **compiled)
    assert "Loading logs/policyflow/Playground-CartpoleBalance-v0_1/" in output
    assert "Loading running average" in output
    assert re.search(r"Mean reward: [\d.]+ ", output)


def test_continue_and_plot(
    installed: Environment, compiled: dict[str, str], trained: tuple[Path, str]
) -> None:
    name = "Playground-CartpoleBalance-v0"
    agent = ["-i", f"logs/policyflow/{name}_1/{name}.zip", "-f", "more", "--eval-freq", "-1"]
    options = ["--env", ENV_ID, "-n", "256", *agent]
    output = installed.run(*TRAIN, *options, *QUICK, folder=trained[0], **compiled)
    assert "Loading pretrained agent" in output
    assert "Loading saved VecNormalize stats" in output
    selection = ["-a", "policyflow", "-e", name, "-f", "logs"]
    table = installed.run(
        "-m", "rl_zoo3.plots.all_plots", *selection, "--no-million", folder=trained[0]
    )
    assert name in table


def test_a_task_that_the_paper_does_not_have(
    installed: Environment, compiled: dict[str, str], tmp_path: Path
) -> None:
    options = ["--env", "Playground/PendulumSwingup-v0", "-n", "64", "--eval-freq", "-1"]
    quick = ["-params", "n_envs:2", "n_steps:16", "batch_size:32", "n_epochs:1"]
    output = installed.run(*TRAIN, *options, *quick, folder=tmp_path, **compiled)
    assert "Saving to logs/policyflow/Playground-PendulumSwingup-v0_1" in output


def test_a_mistyped_task(installed: Environment, tmp_path: Path) -> None:
    options = ["--env", "Playground/PendulumSwingUpp-v0"]
    output = installed.run(*TRAIN, *options, folder=tmp_path, status=1)
    assert "MuJoCo Playground has no task 'PendulumSwingUpp'; nearest: PendulumSwingup" in output
