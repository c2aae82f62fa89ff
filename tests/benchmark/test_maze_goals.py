"""Where episodes in the maze end."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium_robotics")

from sb3_policyflow.benchmark.measure.maze_goals import evaluate_maze_goals
from sb3_policyflow.imitation.demonstrators import POINT_MAZE_STYLES, PointMazeDemonstrator


class Guide(PointMazeDemonstrator):
    """Goes to goals by turns: in environment 0 to goal 0, in 1 to goal 1, in 4 nowhere."""

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        self._chosen = np.arange(len(observation)) % 4
        actions = self(observation, np.zeros(len(observation), dtype=bool))
        actions[4:] = 0
        return actions.clip(-1, 1), None


@pytest.mark.slow
def test_episodes_are_counted_at_the_goal_where_they_end() -> None:
    report = evaluate_maze_goals(Guide(POINT_MAZE_STYLES["good"], seed=0), n=5)
    assert report.counts == (1, 1, 1, 1)
    assert (report.n_goals, report.n_missed, report.entropy) == (4, 1, 1.0)
    assert 300 < report.mean_return < 500
