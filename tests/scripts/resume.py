"""Trains in a process of its own, wholly or from a checkpoint, and says what came out.

python tests/scripts/resume.py whole  FOLDER ALGORITHM    trains, with a checkpoint half-way
python tests/scripts/resume.py resume FOLDER ALGORITHM    goes on from that checkpoint

Prints one line: a digest of everything that the rest of the training depends on.
"""

import pickle
import sys
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback
from tests.helpers import digest

ALGORITHMS: dict[str, type[Any]] = {"PolicyFlow": PolicyFlow, "FPO": FPO, "DPPO": DPPO}
OPTIONS: dict[str, dict[str, Any]] = {
    "PolicyFlow": {"brownian_coef": "lin_0.25"},
    "FPO": {},
    # The critic's warm-up ends, and a part of the chain is frozen, on either side of the file.
    "DPPO": {"n_critic_warmup": 3, "n_denoising_steps": 4, "n_finetuned_steps": 2},
}
N_ENVS, N_STEPS, ITERATIONS = 8, 32, 4
TOTAL = N_ENVS * N_STEPS * ITERATIONS
HALF = TOTAL // 2


class KeepEnvState(BaseCallback):
    """Writes the state of the environment half-way, which MultiGoal alone can tell."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == HALF:
            environment: Any = self.training_env  # wrappers find it in MultiGoalVecEnv
            state = pickle.dumps(environment.get_state())
            (self.folder / f"env_{HALF}.pkl").write_bytes(state)


def whole(folder: Path, algorithm: type[Any]) -> Any:
    env = VecNormalize(VecMonitor(MultiGoalVecEnv(N_ENVS, seed=3)), gamma=0.9)
    model = algorithm(
        "MlpPolicy",
        env,
        n_steps=N_STEPS,
        batch_size=64,
        n_epochs=2,
        gamma=0.9,
        clip_range=lambda progress: 0.1 + 0.1 * progress,
        desired_kl=1e-4,
        seed=5,
        policy_kwargs={"net_arch": [16, 16], "embedding_dim": 8},
        **OPTIONS[algorithm.__name__],
    )
    checkpoint = RolloutCheckpointCallback(
        HALF // N_ENVS, str(folder), name_prefix="model", save_vecnormalize=True
    )
    return model.learn(TOTAL, [checkpoint, KeepEnvState(folder)])


def resume(folder: Path, algorithm: type[Any]) -> Any:
    th.rand(3)  # whatever this process has done before
    inner = VecMonitor(MultiGoalVecEnv(N_ENVS))
    inner.set_state(pickle.loads((folder / f"env_{HALF}.pkl").read_bytes()))
    env = VecNormalize.load(str(folder / f"model_vecnormalize_{HALF}_steps.pkl"), inner)
    model = algorithm.load(folder / f"model_{HALF}_steps", env=env, force_reset=False)
    return model.learn(model.remaining_timesteps, reset_num_timesteps=False)


if __name__ == "__main__":
    th.set_num_threads(1)
    mode, where, name = sys.argv[1:]
    train = {"whole": whole, "resume": resume}[mode]
    sys.stdout.write(digest(train(Path(where), ALGORITHMS[name])) + "\n")
