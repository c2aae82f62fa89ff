"""Several ranks do to the parameters what one process with all their environments would."""

from typing import Any

import pytest
import torch as th

from tests.distributed.launch import run_ranks
from tests.distributed.prescribed import (
    ALGORITHMS,
    CASES,
    make_rollouts,
    train_all,
    train_all_through_sockets,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results() -> dict[int, Any]:
    """What 1, 2 and 4 ranks make of every case."""
    rollouts = {name: make_rollouts(name) for name in ALGORITHMS}
    of_ranks = {size: run_ranks(size, train_all, rollouts, size) for size in (2, 4)}
    for size, several in of_ranks.items():
        assert all(isinstance(each, dict) for each in several), several
        for case in CASES:  # the ranks agree to the last bit
            first = several[0][case]["weights"]
            assert all(th.equal(each[case]["weights"], first) for each in several), size
    return {1: train_all(rollouts, 1), **{size: each[0] for size, each in of_ranks.items()}}


@pytest.mark.parametrize("size", [2, 4])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_same_rollouts_give_the_same_parameters(
    results: dict[int, Any], case: tuple[str, str, bool], size: int
) -> None:
    one, several = results[1][case], results[size][case]
    # float32 rounds by 6e-8 of a weight, Adam divides by small gradients.
    tolerance = 1e-12 if case[2] else 2e-5
    assert th.isfinite(one["weights"]).all()
    difference = (several.pop("weights") - one["weights"]).abs().max().item()
    assert difference <= tolerance
    assert several == pytest.approx({k: v for k, v in one.items() if k != "weights"}, rel=1e-9)


def test_it_holds_between_machines() -> None:
    rollouts = {"PolicyFlow": make_rollouts("PolicyFlow")}
    one = train_all(rollouts, 1)
    for several in run_ranks(2, train_all_through_sockets, rollouts, 2):
        for case, result in several.items():
            difference = (result["weights"] - one[case]["weights"]).abs().max().item()
            assert difference <= (1e-12 if case[2] else 2e-5)


def test_the_decisions_were_made(results: dict[int, Any]) -> None:
    stopped = [results[1][name, "early stop", True]["updates"] for name in ALGORITHMS]
    assert min(stopped) < 9
    for name in ALGORITHMS:
        cases = [case for case in CASES if case[0] == name and "adaptive" in case[1]]
        assert {results[1][case]["learning rate"] for case in cases} - {3e-4}
