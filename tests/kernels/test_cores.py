"""Kernels take torch's threads while a model trains, and nobody else notices."""

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_policyflow import FPO, PolicyFlow
from sb3_policyflow.kernels import threads
from sb3_policyflow.kernels.threads import kernels_have_the_cores
from tests.helpers import SMALL, TINY, train


@pytest.fixture(autouse=True)
def _three_threads() -> Iterator[None]:
    n_threads = th.get_num_threads()
    th.set_num_threads(3)
    yield
    th.set_num_threads(n_threads)


def in_another_thread() -> int:
    """How many threads torch has for a thread that starts now."""
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(th.get_num_threads()))
    thread.start()
    thread.join()
    return found[0]


def test_torch_has_one_thread_in_the_block_and_others_notice_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: range(8), raising=False)
    with kernels_have_the_cores():
        assert th.get_num_threads() == 1
        assert threads.n_usable_threads() == 3
        assert in_another_thread() == 3
    assert th.get_num_threads() == threads.n_usable_threads() == 3


def test_no_more_threads_than_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: range(2), raising=False)
    assert threads.n_parts(1000, threads.MIN_FLOPS_PER_THREAD) == 2


def test_an_error_gives_the_threads_back() -> None:
    with pytest.raises(KeyError), kernels_have_the_cores():
        raise KeyError
    assert th.get_num_threads() == 3


def test_who_sets_the_number_in_the_block_keeps_it() -> None:
    with kernels_have_the_cores():
        th.set_num_threads(2)
    assert th.get_num_threads() == 2


class Threads(BaseCallback):
    """Notes how many threads torch has when callbacks are called."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[int] = set()

    def _on_rollout_start(self) -> None:
        self.seen.add(th.get_num_threads())

    def _on_step(self) -> bool:
        self.seen.add(th.get_num_threads())
        return True


class Layer(BaseFeaturesExtractor):
    """An extractor with parameters, which torch works on."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, 4)
        self.layer = th.nn.Linear(3, 4)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features: th.Tensor = self.layer(observations)
        return features


@pytest.mark.parametrize("algorithm", [PolicyFlow, FPO])
@pytest.mark.parametrize(("extractor", "n_threads"), [(None, 1), (Layer, 3)])
def test_an_update_has_one_unless_an_extractor_needs_them(
    algorithm: Any, extractor: Any, n_threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy_kwargs = {**TINY, "features_extractor_class": extractor}
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, **SMALL)
    seen, draw = set(), model.update_class.draw

    def noting(update: Any) -> Any:
        seen.add(th.get_num_threads())
        return draw(update)

    monkeypatch.setattr(model.update_class, "draw", noting)
    callback = Threads()
    train(model, 2 * SMALL["n_steps"], callback=callback)
    assert seen == {n_threads}
    assert callback.seen == {3}
    assert th.get_num_threads() == 3
