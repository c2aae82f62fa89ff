"""What an update takes is in proportion to its minibatch where rows are large, as PPO's is."""

import os
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_policyflow.common import minibatches
from sb3_policyflow.common.tree import CHUNK, SMALL_ROW, are_small, in_chunks
from tests.helpers import TINY, collect


class Images(gym.Env[Any, Any]):
    """Black pictures, alone or in a dictionary."""

    action_space = spaces.Box(-1, 1, (2,))

    def __init__(self, is_dict: bool = False) -> None:
        picture = spaces.Box(0, 255, (3, 36, 36), np.uint8)
        self.is_dict = is_dict
        self.observation_space = (
            spaces.Dict({"picture": picture, "vector": spaces.Box(-1, 1, (2,))})
            if is_dict
            else picture
        )

    def observe(self) -> Any:
        picture = np.zeros((3, 36, 36), np.uint8)
        return {"picture": picture, "vector": np.zeros(2, np.float32)} if self.is_dict else picture

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        return self.observe(), 0.0, False, False, {}


def largest_batch(model: Any) -> int:
    """The most rows that a model's features extractor sees at a time in an update."""
    collect(model)
    sizes: list[int] = []

    def note(module: nn.Module, inputs: Any, outputs: th.Tensor) -> None:
        sizes.append(len(outputs))

    handle = model.policy.features_extractor.register_forward_hook(note)
    model.train()
    handle.remove()
    return max(sizes)


@pytest.mark.parametrize("is_dict", [False, True])
def test_no_more_images_than_a_minibatch_are_evaluated_at_a_time(
    algorithm: type[Any], is_dict: bool
) -> None:
    sizes = {"n_steps": 64, "batch_size": 16, "n_epochs": 1}
    policy = "MultiInputPolicy" if is_dict else "CnnPolicy"
    model = algorithm(policy, Images(is_dict), policy_kwargs=TINY, **sizes)
    assert largest_batch(model) == 16


def test_vectors_are_evaluated_together(algorithm: type[Any]) -> None:
    """As they were before, so that no number changes."""
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, n_steps=64, batch_size=16)
    has_such_a_pass = algorithm.__name__ != "DPPO"
    assert largest_batch(model) == (64 if has_such_a_pass else 16)


@pytest.mark.parametrize("width", [1, SMALL_ROW, SMALL_ROW + 1])
@pytest.mark.parametrize("batch_size", [3, 100_000])
def test_chunks_of_large_rows_are_no_larger_than_a_minibatch(width: int, batch_size: int) -> None:
    sizes: list[int] = []

    def first(part: th.Tensor) -> th.Tensor:
        sizes.append(len(part))
        return part[:, 0]

    n_rows = CHUNK + 1
    numbers = th.arange(n_rows)
    tree = numbers.unsqueeze(1).expand(n_rows, width)
    assert th.equal(in_chunks(first, tree, batch_size), numbers)
    is_small = width <= SMALL_ROW
    assert are_small(tree) == is_small
    assert max(sizes) == (CHUNK if is_small else min(CHUNK, batch_size))


def test_images_are_not_copied_for_an_epoch(
    algorithm: type[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every gather of images takes a minibatch."""
    gathered: list[int] = []
    rows = minibatches.rows

    def noted(tree: Any, chosen: Any) -> Any:
        gathered.append(chosen.stop - chosen.start if isinstance(chosen, slice) else len(chosen))
        return rows(tree, chosen)

    sizes = {"n_steps": 64, "batch_size": 16, "n_epochs": 2}
    model = collect(algorithm("CnnPolicy", Images(), policy_kwargs=TINY, **sizes))
    monkeypatch.setattr(minibatches, "rows", noted)
    model.train()
    assert gathered == [16] * 8


PEAK = """
import re, sys
from pathlib import Path
import stable_baselines3, sb3_policyflow
from tests.common.test_memory import Images
from tests.helpers import TINY, collect
algorithm = getattr(stable_baselines3, sys.argv[1], None) or getattr(sb3_policyflow, sys.argv[1])
model = collect(algorithm("CnnPolicy", Images(), n_steps=8192, batch_size=64, n_epochs=1))
def memory(kind):  # of this program, where ru_maxrss may be that of the one that started it
    status = Path("/proc/self/status").read_text()
    return int(re.search(kind + r":\\s*(\\d+)", status)[1])
model.train()  # what libraries keep for themselves is not counted
Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
before = memory("VmRSS")
model.train()
print((memory("VmHWM") - before) / 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not os.access("/proc/self/clear_refs", os.W_OK), reason="it needs Linux's count of the memory"
)
def test_peak_of_an_update_from_images_is_near_that_of_ppo(algorithm: type[Any]) -> None:
    """It was 250 MB more; the bound leaves room for what the allocator does."""

    def peak(name: str) -> float:
        command = [sys.executable, "-W", "ignore", "-c", PEAK, name]
        return float(subprocess.run(command, capture_output=True, check=True, text=True).stdout)

    assert peak(algorithm.__name__) < peak("PPO") + 20
