"""Minibatches: each sample once, advantages changed for each minibatch by itself."""

from typing import Any

import pytest
import torch as th

from sb3_policyflow.common import minibatches
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples, Minibatches, minibatches_of
from sb3_policyflow.distributed.ranks import Alone


def samples_of(n: int) -> FlowRolloutBufferSamples:
    numbers = th.arange(float(n))
    return FlowRolloutBufferSamples(numbers[:, None], numbers, *[numbers**2] * 3, record=())


@pytest.mark.parametrize("is_copied", [True, False])
@pytest.mark.parametrize("size", [4, 5, 10, 16, 1])
def test_advantages_of_each_minibatch_are_normalized(
    is_copied: bool, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_copied:
        monkeypatch.setattr(minibatches, "SHUFFLED_AT_ONCE", 0)
    order = th.tensor([3, 1, 4, 0, 5, 9, 2, 6, 8, 7])
    found: Any = Minibatches(samples_of(10), order, size)
    assert (found.shuffled is not None) == is_copied
    found.map_advantages(Alone().normalized)
    seen = []
    for batch in found:
        raw = batch.actions**2
        th.testing.assert_close(batch.old_values, raw)
        expected = raw if len(raw) < 2 else (raw - raw.mean()) / (raw.std() + 1e-8)
        th.testing.assert_close(batch.advantages, expected)
        seen += batch.actions.tolist()
    assert seen == order.tolist()
    assert len(found.parts) == -(-10 // size)


def test_advantages_of_the_rollout_stay() -> None:
    samples = samples_of(6)
    found = Minibatches(samples, th.arange(6), 3)
    found.map_advantages(lambda values: 0 * values)
    assert samples.advantages.tolist() == [0, 1, 4, 9, 16, 25]


def test_a_buffer_whose_minibatches_are_of_an_earlier_version_is_named() -> None:
    class Mine:
        def minibatches(self, samples: Any, size: int) -> Any:
            return iter([samples])

    with pytest.raises(TypeError, match=r"Mine\.minibatches must return .*Minibatches"):
        minibatches_of(Mine(), samples_of(4), 2)
