"""Kills a rank with SIGKILL at random moments, and looks at what becomes of the run.

python tests/scripts/kill_ranks.py [KILLS]

torchrun trains with two ranks and ``--max-restarts 1``. After each kill the run must come to its
end by itself, from the last checkpoint if there was one; every file must be whole, and no process
may be left.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback

ROOT = Path(__file__).parents[2]
N_ROLLOUTS, N_STEPS, N_ENVS = 40, 32, 8
MOMENTS = random.Random()
"""Apart from the generator that loading a model seeds."""
TOTAL = N_ROLLOUTS * N_STEPS * 2 * N_ENVS


class Outcome(NamedTuple):
    """When a run was killed, where it went on, and what is wrong, if anything."""

    seconds: float
    went_on_at: int | None
    wrong: str


class NoteStart(BaseCallback):
    """Notes which processes train, and at which timestep they begin.

    :param folder: Where.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_training_start(self) -> None:
        attempt = os.environ["TORCHELASTIC_RESTART_COUNT"]
        note = self.folder / f"{os.environ['RANK']}.{attempt}.start"
        note.write_text(f"{os.getpid()} {self.model.num_timesteps}", encoding="utf-8")

    def _on_step(self) -> bool:
        return True


def train(folder: Path) -> None:
    """What each rank runs."""
    th.set_num_threads(1)
    env = VecNormalize(MultiGoalVecEnv(N_ENVS))
    model = PolicyFlow("MlpPolicy", env, n_steps=N_STEPS, batch_size=64, n_epochs=2, seed=0)
    saving = RolloutCheckpointCallback(2 * N_STEPS, str(folder))
    model.learn(TOTAL, callback=[NoteStart(folder), saving])
    model.save(folder / "final")


def kill_a_rank(folder: Path, seconds: float) -> Outcome:
    """Start a run, kill one of its ranks so long after the start of training, and wait."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--max-restarts=1"]
    command += ["--nproc-per-node=2", __file__, "train", str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    rank = MOMENTS.randrange(2)
    run = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    note = folder / f"{rank}.0.start"
    while not (note.exists() and note.read_text(encoding="utf-8")) and run.poll() is None:
        time.sleep(0.01)
    time.sleep(seconds)
    with suppress(ProcessLookupError):  # it may have come to its end
        os.kill(int(note.read_text(encoding="utf-8").split()[0]), signal.SIGKILL)
    try:
        _, errors = run.communicate(timeout=120)
    except subprocess.TimeoutExpired:
        run.kill()
        return Outcome(seconds, None, "it hangs")
    if run.returncode != 0:
        return Outcome(seconds, None, f"exit code {run.returncode}: {errors.decode()[-6000:]}")
    return Outcome(seconds, *look_at(folder))


def look_at(folder: Path) -> tuple[int | None, str]:
    """Where the restarted run went on, and what is wrong with what it left."""
    for file in folder.glob("*.zip"):
        model = PolicyFlow.load(file)
        if not all(th.isfinite(p).all() for p in model.policy.parameters()):
            return None, f"{file.name} is torn"
    if PolicyFlow.load(folder / "final").num_timesteps != TOTAL:
        return None, "it ended too early or too late"
    for note in folder.glob("*.start"):
        if Path(f"/proc/{note.read_text(encoding='utf-8').split()[0]}").exists():
            return None, "a rank is still there"
    starts = [int(note.read_text(encoding="utf-8").split()[1]) for note in folder.glob("*.1.start")]
    if len(set(starts)) > 1:
        return None, f"the ranks went on at different timesteps: {starts}"
    return (starts[0], "") if starts else (None, "")


def main(n_kills: int) -> int:
    """Kill so many runs; the number of those with which something is wrong."""
    wrong = 0
    for number in range(n_kills):
        with tempfile.TemporaryDirectory() as folder:
            outcome = kill_a_rank(Path(folder), seconds=MOMENTS.uniform(0.0, 6.0))
        wrong += bool(outcome.wrong)
        sys.stdout.write(f"{number + 1}: {outcome}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{n_kills} kills, {wrong} with something wrong\n")
    return wrong


if __name__ == "__main__":
    if sys.argv[1:2] == ["train"]:
        train(Path(sys.argv[2]))
    else:
        sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 50))
