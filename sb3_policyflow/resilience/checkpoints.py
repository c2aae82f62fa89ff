"""Callbacks for runs that must be able to go on exactly."""

from stable_baselines3.common.callbacks import CheckpointCallback


class RolloutCheckpointCallback(CheckpointCallback):
    """SB3's ``CheckpointCallback``, put off to the end of the update that follows.

    SB3's saves in the middle of a rollout, whose transitions are not part of the file: a resumed
    run is repeatable, but not the one that was interrupted. Between an update and the next rollout
    nothing is under way, and it is the same.

    Takes the arguments of ``CheckpointCallback``.
    """

    _due = False

    def _on_step(self) -> bool:
        self._due = self._due or self.n_calls % self.save_freq == 0
        return True

    def _on_rollout_start(self) -> None:
        if self._due:
            self._save()

    def _on_training_end(self) -> None:
        if self._due:
            self._save()

    def _save(self) -> None:
        self._due = False
        # SB3 saves at every multiple of ``save_freq``, and 0 is one.
        n_calls, self.n_calls = self.n_calls, 0
        super()._on_step()
        self.n_calls = n_calls
