"""How many of the maze's four goals a policy ends at, and how evenly."""

from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_policyflow.benchmark.measure.goals import GoalReport, normalizer, report_of
from sb3_policyflow.benchmark.measure.seeding import seeded
from sb3_policyflow.envs.point_maze import (
    ENV_ID,
    GOAL_CELLS,
    SUCCESS_RADIUS,
    cell_center,
    medium_maze,
)
from sb3_policyflow.imitation.demonstrators import make_env
from sb3_policyflow.imitation.episodes import run_episodes

N_ENVS = 10


def evaluate_maze_goals(model: PolicyPredictor, n: int = 200, seed: int = 0) -> GoalReport:
    """Run ``n`` episodes of ``PointMazeMultiGoal-Medium-v0``, and count where they end.

    :param model: Any SB3 algorithm, or another object with its ``predict``.
    :param n: Number of episodes.
    :param seed: Makes the policy's draws repeatable without touching the caller's generators.
    """
    env, normalize = make_env(ENV_ID, min(n, N_ENVS), seed), normalizer(model)

    def act(observations: Any, _starts: Any) -> Any:
        return model.predict(normalize(observations), deterministic=False)[0]

    with seeded(seed, getattr(model, "device", "cpu")):
        episodes = run_episodes(env, act, n)
    env.close()
    ends = np.stack([np.asarray(episode.obs)[-1, :2] for episode in episodes])
    goals = np.stack([cell_center(cell, medium_maze()) for cell in GOAL_CELLS])
    distances = np.linalg.norm(ends[:, None] - goals, axis=-1)
    counts = (distances <= SUCCESS_RADIUS).sum(axis=0)
    return report_of(counts, np.array([episode.rews.sum() for episode in episodes]))
