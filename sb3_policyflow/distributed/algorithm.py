"""An on-policy algorithm that trains in one process, or in as many as torchrun starts."""

import io
import pathlib
from collections.abc import Iterable
from typing import Any

from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_policyflow.device.algorithm import DeviceOnPolicyAlgorithm
from sb3_policyflow.distributed.ranks import Alone, Ranks, current, use_own_gpu


class DistributedOnPolicyAlgorithm(DeviceOnPolicyAlgorithm):
    """A resilient algorithm whose ``learn`` all ranks call together, if there are several.

    Each rank brings environments of its own, as many as the others. What is counted or given for
    all environments counts for those of all ranks: ``batch_size``, ``total_timesteps``,
    ``num_timesteps`` and what follows it. Rank 0 logs, evaluates and saves: ``save`` does nothing
    on the others.
    """

    unsaved = (
        *DeviceOnPolicyAlgorithm.unsaved,
        "rank",
        "ranks",
        "other_resume_states",
        "_shared_training",
    )
    ranks: Ranks = Alone()
    """The processes that train this model."""
    run_id: str = ""
    """What tells a call of torchrun from all others."""
    _shared_training: Any = None
    """What the ranks do together, while they learn."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.ranks = current()
        self.rank = self.ranks.rank
        if self.ranks.size > 1:
            use_own_gpu(kwargs.get("device", "auto"))
        super().__init__(*args, **kwargs)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the generators; see SB3. Each rank's environments have seeds of their own.

        :param seed: That of rank 0 and its first environment; nothing happens without one.
        """
        if seed is not None and self.rank > 0:
            seed = (seed + self.rank * self.n_envs) % 2**32
        super().set_random_seed(seed)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "OnPolicyAlgorithm",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps`` of all ranks together; see SB3.

        :raises RankError: If another rank has stopped with an error.
        :raises ValueError: If the ranks differ, or something cannot be shared out.
        """
        arguments = total_timesteps, callback, log_interval, tb_log_name
        if self.ranks.size == 1:
            return super().learn(*arguments, reset_num_timesteps, progress_bar)
        from sb3_policyflow.distributed.training import SharedTraining

        self._shared_training = SharedTraining(self)
        try:
            self._shared_training.run(super().learn, *arguments, reset_num_timesteps, progress_bar)
        finally:
            self._shared_training = None
        return self

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        if self._shared_training is not None:
            callback = self._shared_training.around(callback)
        return super()._init_callback(callback, progress_bar)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect this rank's part of a rollout; see SB3.

        :return: False on every rank, if a callback of one has stopped the training.
        """
        complete = super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        if self._shared_training is not None:
            complete = self._shared_training.end_rollout(complete)
        return complete

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save the model on rank 0, with the random states of all; see SB3.

        They are those from before the rollout that is under way, or after the last one.
        """
        if self.rank == 0:
            super().save(path, exclude, include)
