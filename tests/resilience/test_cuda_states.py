"""The random state of the GPU travels with the model, where there is one; runs resume on it."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_policyflow import PolicyFlow
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback
from sb3_policyflow.resilience.saving import RandomStates, preserve_rng_state
from tests.helpers import SMALL, TINY, train, weights

needs_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU that torch can use")
CUDA = th.device("cuda", 1)


class Generator:
    """Stands for CUDA's generators: counts what is drawn on each device."""

    def __init__(self) -> None:
        self.drawn = {"cuda:0": 0, "cuda:1": 0}

    def get(self, device: th.device) -> th.Tensor:
        return th.tensor(self.drawn[str(device)])

    def set(self, state: th.Tensor, device: th.device) -> None:
        self.drawn[str(device)] = int(state)


@pytest.fixture
def generator(monkeypatch: pytest.MonkeyPatch) -> Generator:
    """CUDA as it would answer, on a machine that need not have it."""
    pretended = Generator()
    monkeypatch.setattr(th.cuda, "get_rng_state", pretended.get)
    monkeypatch.setattr(th.cuda, "set_rng_state", pretended.set)
    return pretended


def test_the_state_of_the_models_device_is_kept(generator: Generator) -> None:
    generator.drawn["cuda:1"] = 5
    with preserve_rng_state(CUDA):
        generator.drawn.update({"cuda:0": 3, "cuda:1": 9})
    assert generator.drawn == {"cuda:0": 3, "cuda:1": 5}


def test_a_file_from_the_gpu_loads_without_one(generator: Generator) -> None:
    """And a file from the processor says nothing of a GPU's generator."""
    generator.drawn["cuda:1"] = 5
    on_gpu = RandomStates.now(CUDA)
    on_cpu = RandomStates.now(th.device("cpu"))
    generator.drawn["cuda:1"] = 9
    on_gpu.restore(th.device("cpu"))
    on_cpu.restore(CUDA)
    assert on_cpu.cuda is None
    assert generator.drawn["cuda:1"] == 9


class Course(gym.Env[Any, Any]):
    """Sixteen steps that differ from episode to episode by their actions alone."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def observation(self) -> np.ndarray:
        return np.array([np.cos(self.time), self.position], dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time, self.position = 0, 0.0
        return self.observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.time += 1
        self.position += 0.1 * float(action[0])
        reward = -((self.position - 0.5) ** 2)
        return self.observation(), reward, self.time == 16, False, {}


class DrawsFirst(BaseCallback):
    """Draws as training is about to begin, and leaves the generator as it was."""

    def _on_training_start(self) -> None:
        device = self.model.device
        with preserve_rng_state(device):
            self.drawn = th.randn(4, device=device)

    def _on_step(self) -> bool:
        return True


@needs_gpu
def test_learning_and_not_loading_puts_the_generator_back(tmp_path: Path) -> None:
    env = DummyVecEnv([Course])
    model = PolicyFlow("MlpPolicy", env, device="cuda", policy_kwargs=TINY, **SMALL).learn(32)
    model.save(tmp_path / "model")
    saved = th.cuda.get_rng_state(model.device)
    expected = th.randn(4, device="cuda")
    loaded = PolicyFlow.load(tmp_path / "model", env=env, device="cuda")
    loaded.predict(model.observation_space.sample(), deterministic=True)
    # SB3 seeds the generators when it loads a model with a seed.
    assert not th.equal(th.cuda.get_rng_state(model.device), saved)
    callback = DrawsFirst()
    loaded.learn(16, callback, reset_num_timesteps=False)
    assert th.equal(callback.drawn, expected)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_gpu)])
def test_resumed_runs_equal_the_uninterrupted_one(
    algorithm: type[Any], device: str, tmp_path: Path
) -> None:
    """Bit for bit: each rollout begins with an episode, and nothing but the model goes on."""
    env = DummyVecEnv([Course, Course])
    options: dict[str, Any] = {**SMALL, "ent_coef": 0.01, "desired_kl": 0.01}
    model = algorithm("MlpPolicy", env, device=device, policy_kwargs=TINY, **options)
    checkpoint = RolloutCheckpointCallback(32, str(tmp_path), name_prefix="model")
    model.learn(4 * 32, checkpoint)
    for _ in range(2):
        th.randn(3, device=device)
        loaded = algorithm.load(tmp_path / "model_64_steps", env=env, device=device)
        train(loaded, loaded.remaining_timesteps, reset_num_timesteps=False)
        assert loaded.num_timesteps == 4 * 32
        assert th.equal(weights(loaded), weights(model))
