"""Studies that several worker processes share, through each of Optuna's storages."""

import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import optuna
import pytest
import yaml
from installation import Environment
from optuna.trial import TrialState

from sb3_policyflow.integrations.rl_zoo3.samplers import sample_policyflow_params

CHEAP = {
    "rollout_pow": 10,
    "n_minibatches_pow": 2,
    "n_epochs": 3,
    "n_flow_steps": 4,
    "solver": "euler",
    "net_arch": "tiny",
}
ENDLESS = {**CHEAP, "rollout_pow": 15, "n_minibatches_pow": 6, "n_epochs": 20, "solver": "heun"}
WORKER = ["-m", "rl_zoo3.train", "--algo", "policyflow", "--env", "Pendulum-v1"]
SWEEP = [*WORKER, "--optimize", "-n", "1024", "--eval-episodes", "1", "--no-optim-plots"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def postgresql() -> Iterator[str]:
    """The address of a PostgreSQL server of our own."""
    if importlib.util.find_spec("psycopg") is None:
        pytest.skip("psycopg is not installed")
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    initdb = shutil.which("initdb", path=os.pathsep.join(map(str, programs[-1:])) or None)
    if initdb is None:
        pytest.skip("PostgreSQL's initdb is neither on the PATH nor under /usr/lib/postgresql")
    # It refuses to run as root.
    user = "nobody" if os.getuid() == 0 else None
    folder = Path(tempfile.mkdtemp(prefix="postgresql-"))
    if user is not None:
        shutil.chown(folder, user)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    control = [str(Path(initdb).with_name("pg_ctl")), "-D", str(folder / "data"), "-w"]
    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1 -c fsync=off"

    def run(*command: str) -> None:
        subprocess.run(command, user=user, cwd=folder, check=True, stdout=subprocess.DEVNULL)

    run(initdb, "-D", str(folder / "data"), "-A", "trust", "-U", "optuna", "-N")
    run(*control, "-l", str(folder / "log"), "-o", options, "start")
    try:
        yield f"postgresql+psycopg://optuna@127.0.0.1:{port}/postgres"
    finally:
        run(*control, "-m", "immediate", "stop")
        shutil.rmtree(folder)


@pytest.fixture(params=["sqlite", "journal", "postgresql"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """What ``--storage`` is given."""
    if request.param == "postgresql":
        return str(request.getfixturevalue("postgresql"))
    return f"sqlite:///{tmp_path}/study.db" if request.param == "sqlite" else f"{tmp_path}/s.log"


def create_study(storage: str, *enqueued: dict[str, Any]) -> optuna.Study:
    """Create a study as ``optuna create-study`` does, with trials that are to come first."""
    opened: Any = storage
    if storage.endswith(".log"):
        backend = optuna.storages.journal.JournalFileBackend(storage)
        opened = optuna.storages.JournalStorage(backend)
    study = optuna.create_study(storage=opened, study_name="s", direction="maximize")
    for params in enqueued:
        study.enqueue_trial(params)
    return study


def sweep(storage: str, n_trials: int) -> list[str]:
    return [*SWEEP, "--storage", storage, "--study-name", "s", "--n-trials", str(n_trials)]


def wait_until_taken(study: optuna.Study, trial: int, worker: "subprocess.Popen[str]") -> None:
    """Wait for a trial that is in the queue to be run."""
    while study.trials[trial].state == TrialState.WAITING:
        assert worker.poll() is None, worker.communicate()[0]
        time.sleep(0.1)


def test_workers_share_a_study_and_one_is_killed(
    installed: Environment, tmp_path: Path, storage: str
) -> None:
    study = create_study(storage, ENDLESS, CHEAP, CHEAP)
    victim = installed.start(sweep(storage, 9), tmp_path)
    wait_until_taken(study, 0, victim)
    # Each in a folder of its own, as on two machines: reports are named by the second.
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
    workers = [installed.start(sweep(storage, 1), folders[0])]
    if storage.startswith("sqlite"):
        # It cannot lock a row: two workers that look at the same time take the same queued trial.
        wait_until_taken(study, 1, workers[0])
    workers.append(installed.start(sweep(storage, 1), folders[1]))
    victim.send_signal(signal.SIGKILL)
    outputs = [worker.communicate()[0] for worker in workers]

    assert victim.wait() == -signal.SIGKILL
    assert [worker.returncode for worker in workers] == [0, 0], "\n".join(outputs)
    # Each has had a trial of its own.
    assert all("finished with value" in output for output in outputs)
    states = [trial.state for trial in study.trials]
    assert states == [TrialState.RUNNING, TrialState.COMPLETE, TrialState.COMPLETE]


def test_two_workers_start_together_on_a_new_file(installed: Environment, tmp_path: Path) -> None:
    command = sweep(f"sqlite:///{tmp_path}/new.db", 1)
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
    workers = [installed.start(command, folder) for folder in folders]
    outputs = [worker.communicate()[0] for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0], "\n".join(outputs)
    study = optuna.load_study(study_name="s", storage=f"sqlite:///{tmp_path}/new.db")
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 2
    # A trial of 1024 steps has updated its policy at least ten times.
    assert all(trial.params["rollout_pow"] <= 6 for trial in study.trials)


def test_a_diverging_trial_is_pruned(installed: Environment, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/study.db"
    diverging = {**CHEAP, "learning_rate": 1e30, "desired_kl": None, "activation_fn": "relu"}
    study = create_study(storage, diverging, CHEAP)
    output = installed.run(*sweep(storage, 2), folder=tmp_path)
    assert [trial.state for trial in study.trials] == [TrialState.PRUNED, TrialState.COMPLETE]
    assert "Number of finished trials:  2" in output


def test_trial_id_reproduces_a_trial(installed: Environment, tmp_path: Path) -> None:
    """Also where the YAML file has another number of environments by now."""
    storage = f"sqlite:///{tmp_path}/study.db"
    study = create_study(storage, {}, {**CHEAP, "desired_kl": None})
    for _ in range(2):
        trial = study.ask()
        hyperparams = sample_policyflow_params(trial, 1, 4, {})
        study.tell(trial, 0.0)

    options = ["-n", "64", "--eval-freq", "-1", "--storage", storage, "--study-name", "s"]
    output = installed.run(*WORKER, *options, "--trial-id", "1", folder=tmp_path)
    assert "Using 4 environments" in output
    config = tmp_path / "logs/policyflow/Pendulum-v1_1/Pendulum-v1/config.yml"
    saved = dict(yaml.load(config.read_text(), Loader=yaml.UnsafeLoader))
    assert {name: saved[name] for name in hyperparams} == hyperparams
