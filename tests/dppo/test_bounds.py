"""Bounds that stand for none, to which DPPO's "ddpm" would scale its actions."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import SMALL, TINY

LARGEST = float(np.finfo(np.float32).max)


class Bounded(gym.Env[Any, Any]):
    """Two actions, of which the second has bounds of its own."""

    observation_space = spaces.Box(-1, 1, (1,))

    def __init__(self, low: float, high: float) -> None:
        lowest, highest = np.float32([-1, low]), np.float32([1, high])
        self.action_space = spaces.Box(lowest, highest)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(1, np.float32), 0.0, False, False, {}


def make(env: Any, algorithm: type[Any] = DPPO, **options: Any) -> Any:
    return algorithm("MlpPolicy", env, policy_kwargs=TINY, **SMALL, **options)


@pytest.mark.parametrize("bounds", [(-100, 100), (-1e10, 1e10), (0, 1e3), (0, LARGEST)])
def test_bounds_that_seem_to_stand_for_none_are_announced(bounds: tuple[float, float]) -> None:
    with pytest.warns(UserWarning, match=r"scales actions to their bounds.* use process='flow'"):
        make(Bounded(*bounds))


@pytest.mark.parametrize("bounds", [(-LARGEST, LARGEST), (-0.6 * LARGEST, 0.6 * LARGEST)])
def test_bounds_too_far_apart_for_the_scaling_are_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"further apart than a float32 can tell: use process='fl"):
        make(Bounded(*bounds))


def test_bounds_that_mean_something_are_not_announced() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(Bounded(-90, 100)).learn(16)


@pytest.mark.parametrize("algorithm", [PolicyFlow, FPO, DPPO])
@pytest.mark.parametrize("bound", [100.0, LARGEST])
def test_those_who_do_not_scale_can_use_any_bounds(algorithm: type[Any], bound: float) -> None:
    options = {"process": "flow"} if algorithm is DPPO else {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = make(Bounded(-bound, bound), algorithm, **options)
    actions, _ = model.predict(np.zeros((500, 1), np.float32))
    assert actions.std() < 5


def test_a_policy_that_has_learned_is_not_announced_again(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="scales actions"):
        model = make(Bounded(-100, 100))
    model.learn(16).save(tmp_path / "model")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        DPPO.load(tmp_path / "model")


def test_the_announced_deviation_is_that_of_untrained_actions() -> None:
    with pytest.warns(UserWarning, match=r"deviation of untrained actions is about 38\."):
        model = make(Bounded(-100, 100))
    actions, _ = model.predict(np.zeros((5000, 1), np.float32))
    assert actions[:, 1].std() == pytest.approx(38, rel=0.1)
