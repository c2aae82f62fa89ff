"""Demonstrations as a model sees them."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.imitation.demonstrations import Demonstrations, Observations

VALIDATION_DRAWS = 4096
"""Draws in a validation, at least: each held-out transition has as many as that takes."""


class CloningSamples:
    """Demonstrations as a model sees them: normalized, preprocessed, on its device.

    :param model: The model.
    :param shown: Demonstrations that fit it.
    """

    def __init__(self, model: Any, shown: Demonstrations) -> None:
        self._model, self._shown = model, shown
        self._normalize: VecNormalize | None = model.get_vec_normalize_env()
        self.n = len(shown.actions)

    def take_up_statistics(self) -> None:
        """Normalize by the moments of the demonstrations, if the model has none yet."""
        take_up_statistics(self._normalize, self._shown.observations)

    def digest(self) -> str:
        """A hash of the demonstrations."""
        return self._shown.digest()

    def batch(self, indices: np.ndarray) -> tuple[PyTorchObs, th.Tensor]:
        """Preprocessed observations and the policy's own actions of some transitions."""
        observations, actions = self._shown.take(indices)
        if self._normalize is not None:
            observations = self._normalize.normalize_obs(observations)
        tensors, _ = self._model.policy.obs_to_tensor(observations)
        return tensors, self._own_actions(actions)

    def _own_actions(self, actions: np.ndarray) -> th.Tensor:
        """Actions as the policy makes them, before they are scaled to their bounds."""
        policy, space = self._model.policy, self._model.action_space
        if isinstance(space, spaces.Box):
            actions = actions.reshape(-1, *space.shape).clip(space.low, space.high)
            if policy.squash_output:
                actions = policy.scale_action(actions)
            actions = actions.astype(np.float32, copy=False)
        return th.as_tensor(actions, device=self._model.device)

    def split(self, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """Indices to train on, and indices to hold out, drawn at random; whole episodes if known.

        :param fraction: Part to hold out. What is held out may be nothing, what is trained on not.
        """
        episodes = self._shown.episodes
        groups = (
            np.arange(self.n) if episodes is None else np.unique(episodes, return_inverse=True)[1]
        )
        n_groups = groups.max() + 1
        n_held = min(round(fraction * n_groups), n_groups - 1)
        if fraction > 0 and n_groups > 1:
            n_held = max(n_held, 1)
        is_held = np.zeros(n_groups, dtype=bool)
        is_held[np.random.permutation(n_groups)[:n_held]] = True
        held = is_held[groups]
        repeats = -(-VALIDATION_DRAWS // max(held.sum(), 1))
        return np.flatnonzero(~held), np.repeat(np.flatnonzero(held), repeats)


def take_up_statistics(normalize: VecNormalize | None, observations: Observations) -> None:
    """Normalize by the moments of demonstrated observations, if there are none yet.

    :param normalize: The model's wrapper, if it has one.
    :param observations: The demonstrated observations, not normalized.
    """
    if normalize is None or not normalize.norm_obs or not normalize.training:
        return
    statistics: Any = normalize.obs_rms
    if isinstance(statistics, dict):
        for key, of_key in statistics.items():
            _replace_if_fresh(of_key, observations[key])
    else:
        _replace_if_fresh(statistics, observations)


def _replace_if_fresh(statistics: RunningMeanStd, observations: np.ndarray) -> None:
    if statistics.count >= 1:
        return
    statistics.mean = observations.mean(axis=0, dtype=np.float64)
    statistics.var = observations.var(axis=0, dtype=np.float64)
    statistics.count = len(observations)
