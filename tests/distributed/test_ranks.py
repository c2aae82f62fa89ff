"""What ranks agree on, how they end together, and who writes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_policyflow.distributed.group import ProcessGroup
from tests.distributed import workers
from tests.distributed.launch import run_ranks

pytestmark = pytest.mark.slow


def test_merged_statistics_are_those_of_one_process_that_saw_everything() -> None:
    one = workers.recorded_statistics(n_envs=4)
    for several in run_ranks(4, workers.recorded_statistics, 4):
        for merged, whole in zip(several, one, strict=True):
            for ours, theirs in zip(merged, whole, strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-11)


@pytest.mark.parametrize(
    "layout", ["plain", "channels last on rank 1", "two types", "half of the bits"]
)
def test_gradients_are_averaged_whatever_their_layout(layout: str) -> None:
    """Of rank r they are (r + 1) n + 1 for n = 0, 1, ...: in the mean 2 n + 1."""
    for loss, *gradients in run_ranks(3, workers.mean_gradients, layout):
        assert loss == [pytest.approx(370.0)]
        assert gradients == [[2.0 * n + 1 for n in range(size)] for size in (24, 1, 0, 3)]


def test_a_lack_of_memory_is_this_rank_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> None:
        raise th.OutOfMemoryError("no memory left")

    parameter = th.nn.Parameter(th.zeros(2, 3))
    parameter.grad = th.zeros(3, 2).T
    monkeypatch.setattr(th, "cat", fails)
    with pytest.raises(th.OutOfMemoryError, match="no memory left"):
        ProcessGroup(1, 2).average_gradients([parameter], 0.0)


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("environment raises", "Rank 1 has stopped. RuntimeError: the simulator has crashed"),
        ("reward is NaN", "Rank 1 has stopped. NotFiniteError: The environment's reward is not"),
        ("update raises", "Rank 1 has stopped. RuntimeError: out of memory"),
        ("killed", "Another rank is gone without a word"),
    ],
)
def test_a_fault_of_one_rank_ends_the_others_with_its_sentence(fault: str, sentence: str) -> None:
    first, second, third = run_ranks(3, workers.run_with_fault, fault)
    for message, _, is_finite in (first, third):
        assert message.startswith(f"RankError: {sentence}"), message
        assert is_finite
    if fault == "killed":
        assert second is None
    else:
        assert second[0].split(": ", 1)[1] in first[0]


def test_a_loss_that_is_not_finite_ends_all_before_the_step() -> None:
    results = run_ranks(2, workers.run_with_fault, "loss is NaN")
    assert len({message for message, *_ in results}) == 1
    assert results[0][0].startswith("FloatingPointError: The loss of rank 1 is not finite")
    assert all(is_finite for *_, is_finite in results)


def test_a_callback_that_stops_one_rank_stops_all() -> None:
    # 25 steps of 4 environments, and the update of the first rollout
    assert run_ranks(2, workers.run_until_stopped) == [(100, 2), (100, 2)]


def test_what_cannot_be_shared_out_is_refused() -> None:
    sentences = run_ranks(2, workers.refused, True)
    assert "All ranks must have the same n_envs, but rank 0 has 2 and rank 1 has 3." in sentences
    for sentence in run_ranks(2, workers.refused, False):
        assert sentence.startswith("batch_size=15 counts for all 2 ranks together")


@pytest.mark.parametrize(
    ("name", "of_rank_0", "of_rank_1"),
    [
        ("clip_range", "0.1", "0.3"),
        ("clip_range_vf", "None", "0.2"),
        ("learning_rate", "0.001", "'0.001 at first and 0.0 at the end'"),
        ("n_flow_steps", "2", "3"),
        ("log_std_bounds", "[-2.0, 0.0]", "[-1.0, 0.0]"),
        ("lr_adaptation_kwargs", "{'factor': 1.2}", "{'factor': 1.3}"),
        ("policy_kwargs", "{", "{"),
    ],
)
def test_other_options_than_those_of_the_other_ranks_are_refused(
    name: str, of_rank_0: str, of_rank_1: str
) -> None:
    said = f"All ranks must have the same {name}, but rank 0 has {of_rank_0}"
    first, second = run_ranks(2, workers.refused_option, name)
    assert first.startswith(said), first
    assert f" and rank 1 has {of_rank_1}" in first
    assert f"All ranks must have the same {name}, but rank 1 has {of_rank_1}" in second


def test_ranks_with_objects_of_their_own_that_are_alike_train() -> None:
    assert run_ranks(2, workers.run_alike) == ["no error", "no error"]


def test_resumed_ranks_end_as_the_uninterrupted_ones(tmp_path: Path) -> None:
    first, second = run_ranks(2, workers.each_algorithm, workers.run_whole, tmp_path)
    assert len({*first, *second}) == 6  # each rank has environments and draws of its own
    assert run_ranks(2, workers.each_algorithm, workers.resume, tmp_path) == [first, second]


def test_rank_0_writes_and_counts_for_all(tmp_path: Path) -> None:
    first, second = run_ranks(2, workers.run_with_outputs, tmp_path)
    assert th.equal(first["weights"], second["weights"])
    assert first["timesteps seen"] == second["timesteps seen"] == list(range(4, 897, 4))
    assert (first["evaluations"], second["evaluations"]) == (224, 0)
    assert first["episodes"] == second["episodes"]
    assert len(first["episodes"]) == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "best",
        "evaluations",
        "log",
        "model_0.zip",
    ]
    assert len(list((tmp_path / "log").rglob("events.*"))) == 1
    data: Any = load_from_zip_file(tmp_path / "model_0.zip")[0]
    assert len(data["resume_state"].others) == 1
