"""The record buffers against what SB3's own buffers give back."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_policyflow.common.buffers import DictFlowRolloutBuffer, FlowRolloutBuffer

N_STEPS, N_ENVS = 5, 3
ACTIONS = spaces.Box(-1, 1, (2,))
VECTOR = spaces.Box(-1, 1, (4,))
DICT = spaces.Dict({"a": VECTOR, "b": spaces.Box(-1, 1, (2, 2))})


class Record(NamedTuple):
    latents: th.Tensor
    endpoints: th.Tensor


def observations(space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: observations(part) for key, part in space.items()}
    return np.stack([space.sample() for _ in range(N_ENVS)])


def fill(ours: FlowRolloutBuffer | DictFlowRolloutBuffer, theirs: RolloutBuffer) -> list[Record]:
    records = []
    for _ in range(N_STEPS):
        obs = observations(ours.observation_space)
        step = (obs, np.random.randn(N_ENVS, 2), np.random.randn(N_ENVS), np.zeros(N_ENVS))
        values = th.randn(N_ENVS, 1)
        records.append(Record(th.randn(N_ENVS, 2), th.randn(N_ENVS, 2)))
        ours.add(*step, values, records[-1])
        theirs.add(*step, values, th.zeros(N_ENVS))
    for buffer in (ours, theirs):
        buffer.compute_returns_and_advantage(th.ones(N_ENVS, 1), np.zeros(N_ENVS))
    return records


@pytest.mark.parametrize(
    ("our_class", "their_class", "space"),
    [
        (FlowRolloutBuffer, RolloutBuffer, VECTOR),
        (DictFlowRolloutBuffer, DictRolloutBuffer, DICT),
    ],
)
def test_minibatches_are_those_of_sb3(our_class: Any, their_class: Any, space: Any) -> None:
    ours, theirs = (cls(N_STEPS, space, ACTIONS, n_envs=N_ENVS) for cls in (our_class, their_class))
    fill(ours, theirs)
    np.random.seed(3)
    our_batches = list(ours.get(4))
    np.random.seed(3)
    their_batches = list(theirs.get(4))
    assert [len(batch.actions) for batch in our_batches] == [4, 4, 4, 3]
    for our_batch, their_batch in zip(our_batches, their_batches, strict=True):
        for name in ("observations", "actions", "old_values", "advantages", "returns"):
            th.testing.assert_close(getattr(our_batch, name), getattr(their_batch, name))


def test_records_are_kept_with_their_transitions() -> None:
    buffer = FlowRolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS)
    records = fill(buffer, RolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS))
    latents = np.stack([record.latents.numpy() for record in records])
    np.testing.assert_array_equal(buffer.latents, latents)  # type: ignore[attr-defined]
    assert buffer.endpoints.shape == (N_STEPS, N_ENVS, 2)  # type: ignore[attr-defined]
    where = {tuple(action): index for index, action in enumerate(buffer.actions.reshape(-1, 2))}
    for batch in buffer.get(4):
        assert isinstance(batch.record, Record)
        for action, latent in zip(batch.actions.numpy(), batch.record.latents, strict=True):
            np.testing.assert_array_equal(latent, latents.reshape(-1, 2)[where[tuple(action)]])


def test_reset_forgets_and_the_arrays_keep_their_shape_after_get() -> None:
    buffer = FlowRolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS)
    fill(buffer, RolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS))
    list(buffer.get(4))
    assert buffer.observations.shape == (N_STEPS, N_ENVS, 4)
    buffer.reset()
    assert not buffer.full
    with pytest.raises(AssertionError, match="no complete rollout"):
        buffer.samples()


def test_log_probabilities_in_place_of_a_record_are_refused() -> None:
    buffer = FlowRolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS)
    step = (observations(VECTOR), np.zeros((3, 2)), np.zeros(3), np.zeros(3))
    with pytest.raises(TypeError, match="use SB3's RolloutBuffer"):
        buffer.add(*step, th.zeros(3), th.zeros(3))


class Taken(NamedTuple):
    values: th.Tensor


@pytest.mark.parametrize("n_rollouts", [1, 2])
def test_fields_of_a_record_do_not_replace_attributes_of_the_buffer(n_rollouts: int) -> None:
    buffer = FlowRolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS)
    for _ in range(n_rollouts - 1):
        fill(buffer, RolloutBuffer(N_STEPS, VECTOR, ACTIONS, n_envs=N_ENVS))
        buffer.reset()
    step = (observations(VECTOR), np.zeros((N_ENVS, 2)), *np.zeros((2, N_ENVS)))
    with pytest.raises(TypeError, match=r"cannot have the name of an attribute .*: rename values"):
        buffer.add(*step, th.zeros(N_ENVS), Taken(th.ones(N_ENVS)))
