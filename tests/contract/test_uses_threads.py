"""Threads, processes and copies: one model that many use, or many of one."""

import copy
import multiprocessing
import pickle
import threading
from collections.abc import Callable
from typing import Any

import cloudpickle
import numpy as np
import pytest
import torch as th

from tests.contract.uses import changed_objects, learned, make, output_layer, steps
from tests.helpers import assert_trained, weights, within

SEEN = np.linspace(-1, 1, 30).reshape(10, 3).astype(np.float32)


def actions(model: Any, seen: np.ndarray = SEEN) -> np.ndarray:
    return np.asarray(model.predict(seen, deterministic=True)[0])


# Threads


def at_once(function: Callable[[], Any], n_threads: int = 8) -> list[Any]:
    """What a function returns in several threads that start together, or its exceptions."""
    barrier, found = threading.Barrier(n_threads), []

    def run() -> None:
        barrier.wait()
        try:
            found.append(function())
        except Exception as error:
            found.append(error)

    threads = [threading.Thread(target=run) for _ in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


@pytest.mark.slow
def test_first_predictions_in_threads(any_algorithm: type[Any]) -> None:
    """Many threads ask a model that has never answered, as in a web server."""
    for _ in range(30):
        model = make(any_algorithm)
        found = at_once(lambda model=model: actions(model, SEEN[0]))
        assert not [result for result in found if isinstance(result, Exception)]
        np.testing.assert_array_equal(found, found[:1] * len(found))


@pytest.mark.slow
def test_predictions_in_threads_after_a_change(any_algorithm: type[Any]) -> None:
    """No thread is answered by weights that are no more."""
    model = make(any_algorithm)
    old = 0
    for turn in range(120):
        with th.no_grad():
            output_layer(model).bias.fill_(0.1 * (turn % 7))
        found = np.array(at_once(lambda: actions(model, SEEN[0])), dtype=np.float64)
        alone = actions(model, SEEN[0])
        old += int((np.abs(found - alone).max(axis=1) > 1e-4).sum())
    assert old == 0


@pytest.mark.slow
def test_predictions_in_threads_while_learning(algorithm: type[Any]) -> None:
    """PPO fails now and then: its policy has one distribution, which all threads write into."""
    model, is_done = make(algorithm, n_epochs=4), threading.Event()
    before = weights(model)
    found: list[Any] = []

    def learn() -> None:
        try:
            model.learn(256)
        finally:
            is_done.set()

    def ask() -> None:
        for _ in range(10_000):
            if is_done.is_set():
                break
            found.append(actions(model))

    turns = iter([learn, ask, ask, ask])
    assert [result for result in at_once(lambda: next(turns)(), 4) if result is not None] == []
    assert_trained(model, before)
    assert np.isfinite(found).all()
    assert (np.abs(found) <= 1).all()


def test_actions_handed_out_do_not_change(any_algorithm: type[Any]) -> None:
    model = make(any_algorithm)
    kept: list[tuple[str, Any, Any]] = []
    for row in range(10):
        for seen in (SEEN[row], SEEN[row : row + 1], SEEN):
            for deterministic in (True, False):
                result, _ = model.predict(seen, deterministic=deterministic)
                kept.append(("action", result, result.copy()))
    with th.no_grad():
        outputs = model.policy(th.as_tensor(SEEN))
    kept.append(("outputs", outputs, copy.deepcopy(outputs)))
    model.learn(32)
    assert not changed_objects(kept)


# Copies


COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda model: pickle.loads(pickle.dumps(model)),
    "cloudpickle": lambda model: pickle.loads(cloudpickle.dumps(model)),
}


@pytest.mark.parametrize("kind", COPIES)
def test_copies_train_as_their_originals(any_algorithm: type[Any], kind: str) -> None:
    model = learned(any_algorithm)
    model.env = None if kind == "pickle" else model.env  # local functions are not pickled
    actions(model)  # after an update PPO cannot be copied before it has acted
    twin = COPIES[kind](model)
    np.testing.assert_array_equal(actions(twin), actions(model))
    runs = []
    for one in (model, twin):
        one.set_env(steps())
        th.manual_seed(3)
        np.random.seed(3)
        runs.append(weights(one.learn(32)))
    assert th.equal(*runs)
    expected = actions(model)
    policy = COPIES[kind](model.policy)
    np.testing.assert_array_equal(policy.predict(SEEN, deterministic=True)[0], expected)


def _answer(model: Any, queue: Any) -> None:
    queue.put(actions(model))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_model_in_another_process(any_algorithm: type[Any], method: str) -> None:
    model = learned(any_algorithm)
    expected = actions(model)
    model.env = None
    context: Any = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=_answer, args=(model, queue))
    process.start()
    with within(60):
        np.testing.assert_allclose(queue.get(), expected, atol=1e-6)
    process.join()
