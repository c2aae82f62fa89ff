"""How many of MultiGoal's six goals a policy reaches, and how evenly.

From the center of the workspace all goals are equally good, so an optimal policy that keeps all
its options reaches each with probability 1/6. The paper shows this as a picture of 1000
trajectories; here it is also a number, the normalized entropy over goals.
"""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.benchmark.measure.entropy import normalized_entropy
from sb3_policyflow.benchmark.measure.seeding import seeded
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.envs.multigoal.point_masses import (
    GOALS,
    MAX_EPISODE_STEPS,
    SUCCESS_RADIUS,
    nearest_goal,
)

CENTER = (0.0, 0.0)


@dataclass(frozen=True)
class Trajectories:
    """One episode a row.

    :param positions: The episodes' positions, start included, NaN after an episode's end; shape
        ``(n, MAX_EPISODE_STEPS + 1, 2)``.
    :param lengths: The episodes' numbers of steps, shape ``(n,)``.
    :param returns: The episodes' sums of rewards, shape ``(n,)``.
    """

    positions: NDArray[np.float64]
    lengths: NDArray[np.int_]
    returns: NDArray[np.float64]

    def ends(self) -> NDArray[np.float64]:
        """Where each episode ended, shape ``(n, 2)``."""
        ends: NDArray[np.float64] = self.positions[np.arange(len(self.lengths)), self.lengths]
        return ends

    def goals(self, radius: float = SUCCESS_RADIUS) -> NDArray[np.int_]:
        """Index of the goal within ``radius`` of each episode's end, -1 for none; shape ``(n,)``.

        :raises ValueError: For a radius that two goals could share (or that is not positive).
        """
        if not 0.0 < radius < 2.5:
            raise ValueError(
                f"The goals are 5 apart: give a radius between 0 and 2.5, not {radius}."
            )
        nearest, squared = nearest_goal(self.ends())
        return np.where(squared <= radius**2, nearest, -1)


@dataclass(frozen=True)
class GoalReport:
    """What ``n`` episodes from one start came to, of MultiGoal from the center.

    :param counts: Episodes that ended at each goal.
    :param n_missed: Episodes that ended at none.
    :param entropy: ``normalized_entropy(counts)``.
    :param mean_return: Mean sum of rewards (from the center: not the training return, whose starts
        are spread over the workspace).
    """

    counts: tuple[int, ...]
    n_missed: int
    entropy: float
    mean_return: float

    @classmethod
    def from_summary(cls, summary: Mapping[str, Any]) -> "GoalReport":
        """The report that a run's results have kept, among what else they say of its goals."""
        of_all = summary["n_missed"], summary["entropy"], summary["mean_return"]
        return cls(tuple(summary["counts"]), *of_all)

    @property
    def n_goals(self) -> int:
        """Number of goals that at least one episode ended at."""
        return sum(count > 0 for count in self.counts)

    @property
    def share_missed(self) -> float:
        """Share of the episodes that ended at no goal."""
        return self.n_missed / (sum(self.counts) + self.n_missed)

    def __str__(self) -> str:
        counts = " ".join(map(str, self.counts))
        return (
            f"{self.n_goals} of {len(self.counts)} goals reached ({counts}; no goal: "
            f"{self.n_missed}), normalized entropy {self.entropy:.2f}, "
            f"mean return {self.mean_return:.2f}"
        )


def sample_trajectories(
    model: PolicyPredictor, n: int = 1000, deterministic: bool = False, seed: int | None = 0
) -> Trajectories:
    """Run ``n`` episodes that start at rest in the center of the workspace.

    If the model was trained under ``VecNormalize``, it sees observations normalized the same way.

    :param model: Any SB3 algorithm, or another object with its ``predict``.
    :param n: Number of episodes.
    :param deterministic: Passed to ``predict``; a deterministic policy has one trajectory only.
    :param seed: Makes the policy's draws repeatable without touching the caller's generators;
        ``None`` to go on from wherever they are.
    """
    env = MultiGoalVecEnv(n, seed=seed)
    env.set_options({"position": CENTER})
    normalize = normalizer(model)

    def act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        actions: NDArray[np.float32] = model.predict(
            normalize(observations), deterministic=deterministic
        )[0]
        return actions

    device = getattr(model, "device", "cpu")
    with nullcontext() if seed is None else seeded(seed, device):
        return _run_episodes(env, act)


def _run_episodes(
    env: MultiGoalVecEnv, act: Callable[[NDArray[np.float32]], NDArray[np.float32]]
) -> Trajectories:
    """The first episode of each environment."""
    n = env.num_envs
    positions = np.full((n, MAX_EPISODE_STEPS + 1, 2), np.nan)
    lengths, returns, running = np.zeros(n, dtype=int), np.zeros(n), np.ones(n, dtype=bool)
    observations = np.asarray(env.reset())
    positions[:, 0] = observations[:, :2]
    for step in range(1, MAX_EPISODE_STEPS + 1):
        following, rewards, dones, infos = env.step(act(observations))
        observations = np.asarray(following)
        reached = observations[:, :2].copy()
        for i in np.flatnonzero(dones):
            reached[i] = infos[i]["terminal_observation"][:2]
        positions[running, step] = reached[running]
        lengths += running
        returns += rewards * running
        running &= ~dones
    return Trajectories(positions, lengths, returns)


def normalizer(model: PolicyPredictor) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """What a model's observations go through before it sees them."""
    vec_normalize: VecNormalize | None = getattr(model, "get_vec_normalize_env", lambda: None)()
    if vec_normalize is None:
        return lambda observations: observations
    return lambda observations: np.asarray(vec_normalize.normalize_obs(observations))


def goal_counts(trajectories: Trajectories, radius: float = SUCCESS_RADIUS) -> NDArray[np.int_]:
    """How many episodes ended within ``radius`` of each goal, shape ``(6,)``."""
    goals = trajectories.goals(radius)
    return np.bincount(goals[goals >= 0], minlength=len(GOALS))


def goal_report(trajectories: Trajectories, radius: float = SUCCESS_RADIUS) -> GoalReport:
    """Sum up episodes by the goals they ended at."""
    return report_of(goal_counts(trajectories, radius), trajectories.returns)


def report_of(counts: NDArray[np.int_], returns: NDArray[np.float64]) -> GoalReport:
    """Sum up episodes of any task.

    :param counts: How many of them ended at each goal.
    :param returns: Their sums of rewards.
    """
    return GoalReport(
        counts=tuple(counts.tolist()),
        n_missed=len(returns) - int(counts.sum()),
        entropy=normalized_entropy(counts),
        mean_return=float(returns.mean()),
    )


def evaluate_goals(
    model: PolicyPredictor, n: int = 1000, deterministic: bool = False, seed: int | None = 0
) -> GoalReport:
    """``goal_report`` of ``sample_trajectories``, with its arguments."""
    return goal_report(sample_trajectories(model, n, deterministic, seed))
