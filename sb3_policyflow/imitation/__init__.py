"""Policies that start from demonstrations."""

from sb3_policyflow.imitation.cloning import clone
from sb3_policyflow.imitation.demonstrations import Demonstrations, load_demonstrations
from sb3_policyflow.imitation.episodes import Episode, record_episodes, save_episodes

__all__ = [
    "Demonstrations",
    "Episode",
    "clone",
    "load_demonstrations",
    "record_episodes",
    "save_episodes",
]
