"""Nothing is lost on the way through a file, and no file is half written."""

import io
import os
import random
import subprocess
import sys
import threading
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.resilience.files import atomic_write
from sb3_policyflow.resilience.saving import RandomStates, preserve_rng_state
from tests.helpers import SMALL, last_observations, train, weights

SCRIPTS = Path(__file__).parents[1] / "scripts"


def run_script(*arguments: object) -> str:
    root = str(SCRIPTS.parents[1])
    environment = {**os.environ, "PYTHONPATH": root, "SB3_POLICYFLOW_ZOO": "0"}
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


def small_model(**options: Any) -> PolicyFlow:
    return PolicyFlow("MlpPolicy", "Pendulum-v1", **{**SMALL, **options})


def draws() -> list[float]:
    return [th.rand(1).item(), float(np.random.rand()), random.random()]


# Exact resume


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["PolicyFlow", "FPO", "DPPO"])
def test_resumed_runs_equal_each_other_and_the_uninterrupted_one(
    algorithm: str, tmp_path: Path
) -> None:
    script = SCRIPTS / "resume.py"
    uninterrupted = run_script(script, "whole", tmp_path, algorithm)
    resumed = {run_script(script, "resume", tmp_path, algorithm) for _ in range(2)}
    assert resumed == {uninterrupted}


class Draws(BaseCallback):
    """Draws when a training starts, as training then would."""

    def _on_training_start(self) -> None:
        self.drawn = draws()

    def _on_step(self) -> bool:
        return True


def drawn_in_learning(model: PolicyFlow) -> list[float]:
    callback = Draws()
    model.learn(32, callback, reset_num_timesteps=False)
    return callback.drawn


@pytest.mark.parametrize("by_way_of_another_file", [False, True])
def test_learning_goes_on_from_the_saved_random_states(
    by_way_of_another_file: bool, tmp_path: Path
) -> None:
    model = small_model().learn(32)
    model.save(tmp_path / "model")
    expected = draws()
    assert not hasattr(model, "resume_state")
    env = make_vec_env("Pendulum-v1")
    loaded = PolicyFlow.load(tmp_path / "model", env=env)
    if by_way_of_another_file:
        loaded.save(tmp_path / "model")
        loaded = PolicyFlow.load(tmp_path / "model", env=env)
    draws()
    assert drawn_in_learning(loaded) == expected
    assert drawn_in_learning(loaded) != expected


def test_a_model_that_only_acts_leaves_the_random_states_alone(tmp_path: Path) -> None:
    small_model(seed=None).save(tmp_path / "model")
    first, second = (
        (PolicyFlow.load(tmp_path / "model").predict(np.ones(3, np.float32))[0].item(), *draws())
        for _ in range(2)
    )
    assert not set(first) & set(second)


@pytest.mark.parametrize("options", [{"reseed": True}, {"seed": 0}])
def test_load_can_reseed_as_sb3_does(options: dict[str, Any], tmp_path: Path) -> None:
    small_model().learn(32).save(tmp_path / "model")
    outcomes = []
    for _ in range(2):
        draws()
        env = make_vec_env("Pendulum-v1")
        loaded = PolicyFlow.load(tmp_path / "model", env=env, **options)
        outcomes.append(drawn_in_learning(loaded))
    assert loaded.seed == 0
    assert outcomes[0] == outcomes[1] == drawn_in_learning(small_model())


def test_a_model_without_a_seed_is_repeatable_too(tmp_path: Path) -> None:
    small_model(seed=None).learn(32).save(tmp_path / "model")
    runs = []
    for _ in range(2):
        th.rand(3)
        model = PolicyFlow.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", seed=1))
        model.learn(64, reset_num_timesteps=False)
        runs.append(weights(model))
    assert th.equal(*runs)


def test_files_without_random_states_load(tmp_path: Path) -> None:
    small_model().learn(32).save(tmp_path / "model", exclude=["resume_state"])
    expected = draws()
    loaded = PolicyFlow.load(tmp_path / "model", env=make_vec_env("Pendulum-v1"))
    assert loaded.num_timesteps == 32
    assert drawn_in_learning(loaded) != expected


def test_a_seed_that_is_set_after_loading_counts(tmp_path: Path) -> None:
    env = make_vec_env("Pendulum-v1", 1)
    PolicyFlow("MlpPolicy", env, **SMALL).learn(16).save(tmp_path / "model")
    runs = []
    for seed in (1, 1, 2):
        loaded = PolicyFlow.load(tmp_path / "model", env=env)
        loaded.set_random_seed(seed)
        runs.append(weights(loaded.learn(16)))
    assert th.equal(runs[0], runs[1])
    assert not th.equal(runs[0], runs[2])


def test_going_on_in_the_middle_of_episodes(tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 2))
    model = PolicyFlow("MlpPolicy", env, **SMALL).learn(64)
    model.save(tmp_path / "model")
    assert env.returns.any()
    observations, returns = last_observations(model), env.returns.copy()
    env.returns[:] = 0.0
    fresh = PolicyFlow.load(tmp_path / "model", env=env)
    assert last_observations(fresh) is None
    assert not env.returns.any()
    loaded = PolicyFlow.load(tmp_path / "model", env=env, force_reset=False)
    np.testing.assert_array_equal(last_observations(loaded), observations)
    np.testing.assert_array_equal(env.returns, returns)
    with pytest.raises(
        ValueError, match=r"saved with 2 environments and cannot continue .* with 3"
    ):
        PolicyFlow.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", 3), force_reset=False)


def test_remaining_timesteps(tmp_path: Path) -> None:
    class Interrupted(BaseCallback):
        def _on_step(self) -> bool:
            return self.num_timesteps < 64

    model = small_model(learning_rate=lambda progress: 1e-3 * progress)
    model.learn(160, Interrupted())
    assert (model.num_timesteps, model.remaining_timesteps) == (64, 160 - 64)
    model.save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", env=make_vec_env("Pendulum-v1"))
    train(loaded, loaded.remaining_timesteps, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded.remaining_timesteps) == (160, 0)
    # The schedule has come to its end, too.
    assert loaded.policy.optimizer.param_groups[0]["lr"] == 0.0


def test_no_tensor_is_pickled_with_the_attributes(tmp_path: Path) -> None:
    """A tensor among them would tie the file to the device that it was on."""
    small_model().learn(32).save(tmp_path / "model")
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert data is not None
    assert not [name for name, value in data.items() if isinstance(value, th.Tensor)]


def test_preserve_rng_state() -> None:
    device = th.device("cpu")
    before = RandomStates.now(device)
    with preserve_rng_state(device):
        inside = draws()
    assert draws() == inside
    before.restore(device)
    assert draws() == inside


# Whole files


@pytest.mark.slow
def test_processes_killed_while_saving_leave_whole_files() -> None:
    said = run_script(SCRIPTS / "kill_during_save.py", 8)
    assert said.startswith("8 kills: 8 files whole")


def test_a_save_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    model = small_model()
    model.save(tmp_path / "model.zip")
    old = (tmp_path / "model.zip").read_bytes()
    model.held = threading.Lock()  # type: ignore[attr-defined]
    with pytest.raises(TypeError, match="lock"):
        model.save(tmp_path / "model.zip")
    assert (tmp_path / "model.zip").read_bytes() == old
    assert os.listdir(tmp_path) == ["model.zip"]


def test_a_place_that_cannot_be_written_is_called_what_the_user_calls_it(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"Not a directory: '.*/file/model\.zip'$"):
        small_model().save(tmp_path / "file" / "model")


def test_names_are_those_of_sb3(tmp_path: Path) -> None:
    model = small_model()
    (tmp_path / "folder.zip").mkdir()
    with pytest.warns(UserWarning, match="is a folder"):
        model.save(tmp_path / "folder.zip")
    with pytest.warns(UserWarning, match="does not exist"):
        model.save(str(tmp_path / "new" / "model"))
    found = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert found == {"folder.zip_2", "new/model.zip"}


def test_links_go_on_pointing_at_the_file(tmp_path: Path) -> None:
    model = small_model()
    model.save(tmp_path / "model.zip")
    (tmp_path / "latest.zip").symlink_to("model.zip")
    model.num_timesteps = 7
    model.save(tmp_path / "latest.zip")
    assert (tmp_path / "latest.zip").is_symlink()
    assert PolicyFlow.load(tmp_path / "model").num_timesteps == 7


def test_permissions_are_the_usual_ones(tmp_path: Path) -> None:
    (tmp_path / "usual").touch()
    with atomic_write(tmp_path / "file") as file:
        file.write(b"x")
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_file_objects(tmp_path: Path) -> None:
    model = small_model()
    buffer = io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    assert PolicyFlow.load(buffer).seed == 0
    assert not buffer.closed
    with open(tmp_path / "model.zip", "wb") as file:
        model.save(file)
    with open(tmp_path / "model.zip", "rb") as file:
        assert PolicyFlow.load(file).seed == 0


# What is no model


@pytest.mark.parametrize("kept", [0, 1, 100, -1])
def test_truncated_files(kept: int, tmp_path: Path) -> None:
    small_model().save(tmp_path / "model.zip")
    whole = (tmp_path / "model.zip").read_bytes()
    (tmp_path / "model.zip").write_bytes(whole[:kept])
    with pytest.raises(ValueError, match="not a whole zip archive: it is truncated") as caught:
        PolicyFlow.load(tmp_path / "model")
    assert isinstance(caught.value.__cause__, zipfile.BadZipFile)


def test_damaged_files(tmp_path: Path) -> None:
    small_model().save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        inside = archive.getinfo("policy.pth").header_offset + 500
    damaged = bytearray((tmp_path / "model.zip").read_bytes())
    damaged[inside] ^= 1
    (tmp_path / "model.zip").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"member 'policy\.pth' is damaged"):
        PolicyFlow.load(tmp_path / "model")


def test_archives_of_something_else(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        archive.writestr("beach.jpg", b"")
    with pytest.raises(ValueError, match=r"does not hold a saved model, for it lacks \['data'"):
        PolicyFlow.load(tmp_path / "photos.zip")


def test_models_of_another_algorithm(tmp_path: Path) -> None:
    PPO("MlpPolicy", "Pendulum-v1").save(tmp_path / "ppo")
    with pytest.raises(ValueError, match=r"saved by PPO, not by PolicyFlow: use PPO\.load"):
        PolicyFlow.load(tmp_path / "ppo")


def test_files_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.zip"):
        PolicyFlow.load(tmp_path / "missing")
