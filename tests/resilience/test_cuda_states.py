"""The random state of the GPU travels with the model, where there is one."""

from pathlib import Path
from typing import Any

import pytest
import torch as th

from sb3_policyflow import PolicyFlow
from sb3_policyflow.resilience.saving import RandomStates, random_states_kept

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "seed": 0}
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
    with random_states_kept(CUDA):
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


@pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU that torch can use")
def test_runs_on_a_gpu_go_on_as_they_would_have(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", device="cuda", **SMALL).learn(32)
    model.save(tmp_path / "model")
    expected = th.randn(4, device="cuda")
    th.randn(7, device="cuda")
    PolicyFlow.load(tmp_path / "model", device="cuda")
    assert th.equal(th.randn(4, device="cuda"), expected)
    runs = []
    for _ in range(2):
        loaded = PolicyFlow.load(tmp_path / "model", env=model.get_env(), device="cuda")
        loaded.learn(64, reset_num_timesteps=False)
        runs.append(th.cat([parameter.flatten() for parameter in loaded.policy.parameters()]))
    assert th.equal(*runs)
