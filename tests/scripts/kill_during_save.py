"""Kills processes with SIGKILL while they save, and looks at what they leave.

python tests/scripts/kill_during_save.py [KILLS]

A process saves one model over and over to one file, by turns with all weights 0 and all weights 1.
After each kill the file must load, and its weights must be all 0 or all 1.
"""

import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import torch as th

from sb3_policyflow import PolicyFlow

POLICY = {"net_arch": [64, 64], "embedding_dim": 64}


def save_for_ever(path: Path, model: PolicyFlow) -> None:
    """Save until killed; the first save is announced by the file's existence."""
    number = 0
    while True:
        with th.no_grad():
            for parameter in model.policy.parameters():
                parameter.fill_(number % 2)
        model.save(path)
        number += 1


def kill_while_saving(path: Path, model: PolicyFlow) -> None:
    """Fork a process that saves, and kill it after a random time."""
    pid = os.fork()
    if pid == 0:
        save_for_ever(path, model)
    while not path.exists():
        time.sleep(0.001)
    time.sleep(random.uniform(0.0, 0.1))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def is_whole(path: Path) -> bool:
    """Whether the file loads and holds one state, not parts of two."""
    try:
        model = PolicyFlow.load(path)
    except ValueError:
        return False
    weights = th.cat([parameter.flatten() for parameter in model.policy.parameters()])
    return bool((weights == weights[0]).all())


def count_kills(n_kills: int) -> tuple[int, int]:
    """How many of so many kills left a whole file, and how many fell into the middle of a save."""
    th.set_num_threads(1)
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=POLICY)
    whole = interrupted = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.zip"
        for _ in range(n_kills):
            kill_while_saving(path, model)
            whole += is_whole(path)
            leftovers = list(Path(folder).glob(".*.tmp"))
            interrupted += len(leftovers)
            for leftover in leftovers:
                leftover.unlink()
    return whole, interrupted


if __name__ == "__main__":
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    n_whole, n_interrupted = count_kills(kills)
    sys.stdout.write(
        f"{kills} kills: {n_whole} files whole; {n_interrupted} kills fell between the opening of "
        "the temporary file and its renaming.\n"
    )
    sys.exit(n_whole != kills)
