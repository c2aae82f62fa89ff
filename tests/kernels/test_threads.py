"""Threads may share a policy: none sees half of a cache, nor an action of weights that are gone."""

import copy
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_policyflow import PolicyFlow
from sb3_policyflow.kernels import flow
from sb3_policyflow.kernels.inspection import KernelView
from tests.helpers import SMALL, TINY
from tests.kernels.plain import make_field

N_THREADS = 8
OPTIONS: dict[str, Any] = {"solver": "midpoint", "n_steps": 4, "end_time": 1.0}
Z, S = th.linspace(-1, 1, 10).view(5, 2), th.linspace(-2, 1, 15).view(5, 3)


def at_once(run: Callable[[], Any], n_threads: int = N_THREADS) -> list[Any]:
    """What calls of a function return that start together, each in a thread of its own."""
    barrier, found, errors = threading.Barrier(n_threads), list[Any](), list[BaseException]()

    def call() -> None:
        barrier.wait()
        try:
            found.append(run())
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=call) for _ in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    return found


def make_model(algorithm: Any, **options: Any) -> Any:
    return algorithm(
        "MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, device="cpu", **{**SMALL, **options}
    )


def act(model: Any) -> float:
    return float(model.predict(np.zeros(3, np.float32), deterministic=True)[0][0])


@pytest.fixture
def _eager_switches() -> Any:
    """Let Python switch between threads as often as it can."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("_eager_switches")
def test_first_use_by_several_threads(algorithm: Any) -> None:
    for _ in range(10):
        model = make_model(algorithm)
        assert len(set(at_once(lambda model=model: act(model)))) == 1


@pytest.mark.usefixtures("_eager_switches")
def test_no_thread_acts_with_old_weights(algorithm: Any) -> None:
    model = make_model(algorithm)
    for i in range(30):
        with th.no_grad():
            model.policy.velocity.output.bias.fill_(0.1 * (i % 7))
        [found] = set(at_once(lambda: act(model)))
        assert found == pytest.approx(act(copy.deepcopy(model.policy)), abs=1e-5)


@pytest.mark.usefixtures("_eager_switches")
@pytest.mark.parametrize("swap", [False, True])
def test_weights_that_change_back_and_forth_meanwhile(algorithm: Any, swap: bool) -> None:
    """Values change in place, or ``load_from_vector`` gives the parameters another memory."""
    model = make_model(algorithm)
    vectors, actions = [], []
    for value in (0.1, 0.5):
        with th.no_grad():
            model.policy.velocity.output.bias.fill_(value)
        vectors.append(model.policy.parameters_to_vector())
        actions.append(act(model))
    stop = threading.Event()

    def change() -> None:
        i = 0
        while not stop.is_set():
            i += 1
            if swap:
                model.policy.load_from_vector(vectors[i % 2])
            else:
                with th.no_grad():
                    model.policy.velocity.output.bias.fill_((0.1, 0.5)[i % 2])

    changing = threading.Thread(target=change)
    changing.start()
    try:
        for found in at_once(lambda: [act(model) for _ in range(40)], 3):
            low, high = min(actions) - 1e-5, max(actions) + 1e-5
            assert all(low <= action <= high for action in found)
    finally:
        stop.set()
        changing.join()
    for vector, action in zip(vectors, actions, strict=True):
        model.policy.load_from_vector(vector)
        assert set(at_once(lambda: act(model))) == {action}


def test_acting_while_another_thread_trains(algorithm: Any) -> None:
    model = make_model(algorithm, n_epochs=4)
    learning = threading.Thread(target=lambda: model.learn(8 * SMALL["n_steps"]))
    learning.start()
    while learning.is_alive():
        assert all(np.isfinite(at_once(lambda: act(model), 3)))
    learning.join()
    assert model.num_timesteps == 8 * SMALL["n_steps"]
    assert set(at_once(lambda: act(model))) == {act(copy.deepcopy(model.policy))}


def test_a_reading_is_seen_when_it_is_complete() -> None:
    """Whoever asks while another thread reads, reads for itself."""
    field = make_field(2, 3, [8])
    original, asked = field._view._read, list[Any]()

    def read(*args: Any) -> Any:
        if not asked:
            asked.append(None)
            asked.append(view.of(field))
        return original(*args)

    view = KernelView(read)
    parts = view.of(field)
    assert not isinstance(parts, str)
    assert type(asked[1]) is type(parts)


def test_what_is_derived_belongs_to_the_weights_it_is_kept_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another thread changes the weights during the derivation, and changes them back."""
    field, derive = make_field(2, 3, [8]), flow._make_plan
    with th.no_grad():
        expected = copy.deepcopy(field).integrate(Z, S, **OPTIONS)

        def disturbed(*args: Any) -> Any:
            kept = field.output.bias.clone()
            field.output.bias.fill_(7.0)
            field.time_embedding.mlp[0].weight.mul_(2)
            plan = derive(*args)
            field.output.bias.copy_(kept)
            field.time_embedding.mlp[0].weight.mul_(0.5)
            return plan

        monkeypatch.setattr(flow, "_make_plan", disturbed)
        assert th.equal(field.integrate(Z, S, **OPTIONS), expected)
        assert th.equal(field.integrate(Z, S, **OPTIONS), expected)


def test_parts_hold_the_memory_that_they_name() -> None:
    """Another thread replaces a parameter's memory between the question and the kernel."""
    field = make_field(2, 3, [8])
    parts = field.parts()
    assert not isinstance(parts, str)
    copies = [tensor.clone() for tensor in parts.held]
    with th.no_grad():
        for parameter in field.parameters():
            parameter.data = th.zeros_like(parameter)
    assert [tensor.data_ptr() for tensor in parts.held] == parts.places
    assert all(map(th.equal, parts.held, copies))
    assert field.parts() is not parts


AFTER_THE_MAIN_THREAD = """
import threading
import torch as th
from sb3_policyflow.kernels import threads

threads.MIN_FLOPS_PER_THREAD = 1
th.set_num_threads(2)
ended = threading.main_thread().join

def work():
    ended()
    rows = []
    parts = threads.n_parts(100, 1000)
    threads.in_parts(100, parts, lambda part, start, stop: rows.append((start, stop)))
    print(parts, sorted(rows))

threading.Thread(target=work).start()
"""


@pytest.mark.slow
def test_a_thread_may_outlive_the_main_thread() -> None:
    """A script that lets a thread train has nothing else to do than to end."""
    done = subprocess.run(
        [sys.executable, "-c", AFTER_THE_MAIN_THREAD], capture_output=True, text=True, check=True
    )
    assert done.stdout == "2 [(0, 50), (50, 100)]\n", done.stderr


def test_values_of_a_few_states_come_from_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """As at time limits: torch's linear layers would wake its threads while a flow is sampled."""
    kwargs = {"share_features_extractor": False, "net_arch": [8, 8]}
    policy = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=kwargs).policy
    states = th.randn(5, 3)
    with th.no_grad():
        expected = ActorCriticPolicy.predict_values(policy, states)
        monkeypatch.delattr(th.nn.Linear, "forward")
        th.testing.assert_close(policy.predict_values(states), expected)
