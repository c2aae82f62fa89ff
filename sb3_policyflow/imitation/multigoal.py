"""Demonstrators of ``MultiGoal-v0``, which go to one of the goals that are near."""

from typing import NamedTuple

import numpy as np

from sb3_policyflow.envs.multigoal import MultiGoalVecEnv
from sb3_policyflow.envs.multigoal.point_masses import DT, GOALS, MAX_EPISODE_STEPS
from sb3_policyflow.envs.type_aliases import FloatArray
from sb3_policyflow.imitation.demonstrations import Demonstrations

N_ENVS = 1024


class Style(NamedTuple):
    """How a demonstrator moves.

    :param stiffness: Acceleration for each unit of distance to the goal.
    :param damping: Acceleration for each unit of speed, against it.
    :param max_acceleration: Greatest acceleration in each direction.
    :param noise: Standard deviation of noise on the accelerations.
    """

    stiffness: float = 6.0
    damping: float = 4.5
    max_acceleration: float = 5.0
    noise: float = 0.0


STYLES = {
    "good": Style(),
    "slow": Style(stiffness=1.0, damping=2.5, max_acceleration=1.0),
    "noisy": Style(noise=1.0),
}
"""Demonstrators by name."""
INDECISION = 0.3
"""Goals further away than the nearest one by this much are chosen e times less often."""


def choose_goals(positions: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A goal for each position, nearer ones more often, shape (n, 2).

    Its probability is proportional to exp(-distance / INDECISION): from the center, all six alike.

    :param positions: Shape (n, 2).
    :param rng: Draws them.
    """
    distances = np.linalg.norm(positions[:, None] - GOALS, axis=-1)
    gumbel = rng.gumbel(size=distances.shape)
    chosen: FloatArray = GOALS[(gumbel - distances / INDECISION).argmax(axis=1)]
    return chosen


def accelerations(states: FloatArray, goals: FloatArray, style: Style) -> FloatArray:
    """What a demonstrator does, shape (n, 2), without its noise.

    :param states: Positions and velocities, shape (n, 4).
    :param goals: Where each point goes, shape (n, 2).
    :param style: How it moves.
    """
    positions, velocities = states[:, :2], states[:, 2:]
    # The position moves with the velocity before this step.
    offset = goals - (positions + DT * velocities)
    wanted = style.stiffness * offset - style.damping * velocities
    return wanted.clip(-style.max_acceleration, style.max_acceleration)


def demonstrate(style: str, n_transitions: int, seed: int = 0) -> Demonstrations:
    """Whole episodes of a demonstrator, from random starts.

    :param style: "good", "slow" or "noisy".
    :param n_transitions: How many transitions, at least.
    :param seed: Seed of starts, goals and noise.
    """
    chosen, rng = STYLES[style], np.random.default_rng(seed)
    n_envs = min(N_ENVS, -(-n_transitions // MAX_EPISODE_STEPS))
    env = MultiGoalVecEnv(n_envs, seed=seed)
    states = np.asarray(env.reset())
    goals = choose_goals(states[:, :2], rng)
    number, sums = np.arange(n_envs), np.zeros(n_envs)
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    returns: dict[int, float] = {}
    while MAX_EPISODE_STEPS * len(returns) < n_transitions:
        actions = accelerations(states, goals, chosen)
        actions = (actions + chosen.noise * rng.standard_normal(actions.shape)).clip(-5, 5)
        parts.append((states, actions.astype(np.float32), number.copy()))
        following, rewards, dones, _ = env.step(parts[-1][1])
        states, sums = np.asarray(following), sums + rewards
        for index in np.flatnonzero(dones).tolist():
            returns[int(number[index])] = sums[index]
            number[index], sums[index] = number.max() + 1, 0.0
            goals[index] = choose_goals(states[index : index + 1, :2], rng)[0]
    return _whole_episodes(parts, returns, env)


def _whole_episodes(
    parts: list[tuple[FloatArray, FloatArray, FloatArray]],
    returns: dict[int, float],
    env: MultiGoalVecEnv,
) -> Demonstrations:
    """The transitions of the episodes that have ended, one episode after the other."""
    states, actions, numbers = (np.concatenate(values) for values in zip(*parts, strict=True))
    order = np.argsort(numbers, kind="stable")
    order = order[np.isin(numbers[order], list(returns))]
    episodes = np.unique(numbers[order], return_inverse=True)[1]
    in_order = np.array([returns[number] for number in sorted(returns)])
    spaces = env.observation_space, env.action_space
    return Demonstrations(states[order], actions[order], episodes, in_order, *spaces)
