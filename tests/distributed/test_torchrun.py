"""Started as users start it: by torchrun, and by rl_zoo3 under torchrun."""

import sys
from pathlib import Path

import pytest
import yaml

from sb3_policyflow import PolicyFlow
from tests.distributed.launch import torchrun

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import kill_ranks

pytestmark = pytest.mark.slow


def test_a_killed_rank_is_restarted_and_the_run_goes_on(tmp_path: Path) -> None:
    outcome = kill_ranks.kill_a_rank(tmp_path, seconds=1.5)
    assert outcome.wrong == ""
    checkpoints = [path.stem.split("_")[2] for path in tmp_path.glob("rl_model_*.zip")]
    assert outcome.went_on_at is None or outcome.went_on_at in {0, *map(int, checkpoints)}


def test_the_zoo_shares_environments_and_writes_one_folder(tmp_path: Path) -> None:
    hyperparams = "n_envs:4", "n_steps:32", "batch_size:32", "n_epochs:1", "normalize:True"
    done = torchrun(
        *(2, "-m", "rl_zoo3.train", "--algo", "policyflow", "--env", "Pendulum-v1"),
        *("-n", 1024, "-f", tmp_path, "--eval-freq", 512, "--eval-episodes", 1),
        *("--hyperparams", *hyperparams),
    )
    assert done.returncode == 0, done.stderr[-4000:]
    (run,) = (tmp_path / "policyflow").iterdir()
    names = {path.name for path in run.iterdir()}
    assert {f"{i}.monitor.csv" for i in range(4)} | {"Pendulum-v1.zip", "best_model.zip"} <= names
    model = PolicyFlow.load(run / "Pendulum-v1.zip")
    assert (model.num_timesteps, model.batch_size, model.n_envs) == (1024, 32, 2)
    config = yaml.unsafe_load((run / "Pendulum-v1" / "config.yml").read_text(encoding="utf-8"))
    assert config["n_envs"] == 4
