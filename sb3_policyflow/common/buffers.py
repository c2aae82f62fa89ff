"""Rollout buffers that also store how each action was made."""

from collections.abc import Generator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples, Minibatches
from sb3_policyflow.resilience.collection import PendingBonus


class RecordBufferMixin(RolloutBuffer):
    """Stores the NamedTuple of tensors that a flow policy returns in place of log probabilities.

    SB3's ``collect_rollouts`` hands the third value of ``policy.forward`` to ``add`` unseen. Each
    of its fields becomes an attribute of the buffer, an array of shape (buffer_size, n_envs, ...):
    PolicyFlow's are ``latents`` (z) and ``endpoints`` (phi).
    """

    record_type: type[Any] | None
    _record_fields: tuple[str, ...] = ()
    pending_bonus: PendingBonus | None
    """What is to be added to the rewards of the next step: see :class:`PendingBonus`."""

    def reset(self) -> None:
        """Forget all transitions."""
        self.record_type = None
        self.pending_bonus = None
        # NaN shows at once where log probabilities are read from this buffer by mistake.
        self._no_log_prob = th.full((self.n_envs,), th.nan, dtype=th.float32, device="cpu")
        super().reset()
        # SB3 stores actions in the dtype of the space, which may have less than single precision.
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
        for name, values in zip(record._fields, record, strict=True):
            getattr(self, name)[self.pos] = values.cpu().numpy()
        if self.pending_bonus is not None:
            reward = self.pending_bonus.settle(reward)
            self.pending_bonus = None
        super().add(obs, action, reward, episode_start, value, self._no_log_prob)

    def _allocate(self, record: Any) -> None:
        new = (name for name in record._fields if name not in self._record_fields)
        if taken := [name for name in new if hasattr(self, name)]:
            raise TypeError(
                f"A field of {type(record).__name__} cannot have the name of an attribute of "
                f"{type(self).__name__}: rename {', '.join(taken)}."
            )
        self.record_type, self._record_fields = type(record), record._fields
        for name, values in record._asdict().items():
            shape = (self.buffer_size, *values.shape)
            setattr(self, name, np.zeros(shape, dtype=values.cpu().numpy().dtype))

    def samples(self) -> FlowRolloutBufferSamples:
        """All transitions on the buffer's device, step after step: n = buffer_size * n_envs.

        On a CPU they are views of the buffer's arrays.
        """
        assert self.full, "The buffer holds no complete rollout yet"
        assert self.record_type is not None

        def flatten(array: np.ndarray) -> th.Tensor:
            flat = array.reshape(self.buffer_size * self.n_envs, *array.shape[2:])
            return th.as_tensor(flat, device=self.device)

        observations: Any = self.observations
        if isinstance(observations, dict):
            observations = {key: flatten(values) for key, values in observations.items()}
        else:
            observations = flatten(observations)
        record = (flatten(getattr(self, name)) for name in self.record_type._fields)
        return FlowRolloutBufferSamples(
            observations=observations,
            actions=flatten(self.actions),
            old_values=flatten(self.values),
            advantages=flatten(self.advantages),
            returns=flatten(self.returns),
            record=self.record_type(*record),
        )

    def minibatches(
        self, samples: FlowRolloutBufferSamples, batch_size: int | None = None
    ) -> Minibatches:
        """Go through ``samples`` once, in random order.

        The order is the one in which SB3's buffer gives back its transitions; a GPU draws its own.

        :param samples: What :meth:`samples` returned, perhaps with something drawn for each.
        :param batch_size: Samples in a minibatch; all of them if not given.
        """
        n_samples = self.buffer_size * self.n_envs
        if self.device.type == "cuda":
            drawn = th.randperm(n_samples, device=self.device)
            return Minibatches(samples, drawn, batch_size or n_samples)
        order = np.random.permutation(n_samples)
        # SB3 numbers transitions environment by environment, ``samples`` step by step.
        indices = order % self.buffer_size * self.n_envs + order // self.buffer_size
        ordered = th.as_tensor(indices, device=self.device)
        return Minibatches(samples, ordered, batch_size or n_samples)

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """Go through the rollout once in minibatches, in random order."""
        yield from self.minibatches(self.samples(), batch_size)


class FlowRolloutBuffer(RecordBufferMixin):
    """SB3's ``RolloutBuffer`` with the record of a flow policy."""


class DictFlowRolloutBuffer(RecordBufferMixin, DictRolloutBuffer):
    """SB3's ``DictRolloutBuffer`` with the record of a flow policy."""
