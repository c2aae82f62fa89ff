"""Rollout buffers that also store how each action was made."""

from collections.abc import Generator, Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_policyflow.common.type_aliases import FlowRolloutBufferSamples, rows, size_in_bytes

SHUFFLED_AT_ONCE = 2**26
"""Bytes of a rollout up to which a shuffled copy of it is made for each epoch."""


class RecordBufferMixin(RolloutBuffer):
    """Stores the NamedTuple of tensors that a flow policy returns in place of log probabilities.

    SB3's ``collect_rollouts`` hands the third value of ``policy.forward`` to ``add`` unseen. Each
    of its fields becomes an attribute of the buffer, an array of shape (buffer_size, n_envs, ...):
    PolicyFlow's are ``latents`` (z) and ``endpoints`` (phi).
    """

    record_type: type[Any] | None

    def reset(self) -> None:
        """Forget all transitions."""
        self.record_type = None
        super().reset()
        # SB3 takes the precision of the space. Half of it would blur how an action was made.
        self.actions = self.actions.astype(np.float32, copy=False)

    def add(
        self,
        obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        episode_start: np.ndarray,
        value: th.Tensor,
        record: Any,
    ) -> None:
        """Store one step of every environment.

        :param record: How the actions were made: a NamedTuple of tensors of shape (n_envs, ...).
            See SB3 for the others.
        :raises TypeError: If the policy returned log probabilities in place of a record.
        """
        if not hasattr(record, "_fields"):
            raise TypeError(
                f"{type(self).__name__} stores how a flow policy made its actions, but the policy "
                f"returned a {type(record).__name__}: use SB3's RolloutBuffer for such a policy."
            )
        if self.record_type is None:
            self._allocate(record)
        for name, values in record._asdict().items():
            getattr(self, name)[self.pos] = values.cpu().numpy()
        # Whoever reads log probabilities from this buffer by mistake shall see it at once.
        no_log_prob = th.full((self.n_envs,), th.nan)
        super().add(obs, action, reward, episode_start, value, no_log_prob)

    def _allocate(self, record: Any) -> None:
        self.record_type = type(record)
        for name, values in record._asdict().items():
            shape = (self.buffer_size, *values.shape)
            setattr(self, name, np.zeros(shape, dtype=values.cpu().numpy().dtype))

    def samples(self) -> FlowRolloutBufferSamples:
        """All transitions on the buffer's device, step after step: n = buffer_size * n_envs.

        On a CPU they are views of the buffer's arrays.
        """
        assert self.full, "The buffer holds no complete rollout yet"
        assert self.record_type is not None
        record = self.record_type(
            *(self._flatten(getattr(self, name)) for name in self.record_type._fields)
        )
        return FlowRolloutBufferSamples(
            observations=self._flat_observations(),
            actions=self._flatten(self.actions),
            old_values=self._flatten(self.values),
            advantages=self._flatten(self.advantages),
            returns=self._flatten(self.returns),
            record=record,
        )

    def _flatten(self, array: np.ndarray) -> th.Tensor:
        flat = array.reshape(self.buffer_size * self.n_envs, *array.shape[2:])
        return th.as_tensor(flat, device=self.device)

    def _flat_observations(self) -> Any:
        return self._flatten(self.observations)

    def minibatches(
        self, samples: FlowRolloutBufferSamples, batch_size: int | None = None
    ) -> Iterator[FlowRolloutBufferSamples]:
        """Go through ``samples`` once, in random order.

        The order is the one in which SB3's buffer gives back its transitions.

        :param samples: What :meth:`samples` returned, perhaps with probes added.
        :param batch_size: Samples in a minibatch; all of them if not given.
        """
        n_samples = self.buffer_size * self.n_envs
        order = np.random.permutation(n_samples)
        # SB3 numbers transitions environment by environment, ``samples`` step by step.
        indices = th.as_tensor(
            order % self.buffer_size * self.n_envs + order // self.buffer_size, device=self.device
        )
        size = batch_size or n_samples
        parts = [slice(start, start + size) for start in range(0, n_samples, size)]
        if size_in_bytes(samples) <= SHUFFLED_AT_ONCE:
            # Many views of one shuffled copy are faster than many gathers of few rows.
            shuffled = rows(samples, indices)
            yield from (rows(shuffled, part) for part in parts)
        else:
            yield from (rows(samples, indices[part]) for part in parts)

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """Go through the rollout once in minibatches, in random order."""
        yield from self.minibatches(self.samples(), batch_size)


class FlowRolloutBuffer(RecordBufferMixin):
    """SB3's ``RolloutBuffer`` with the record of a flow policy."""


class DictFlowRolloutBuffer(RecordBufferMixin, DictRolloutBuffer):
    """SB3's ``DictRolloutBuffer`` with the record of a flow policy."""

    def _flat_observations(self) -> dict[str, th.Tensor]:
        return {key: self._flatten(values) for key, values in self.observations.items()}
