"""MultiGoal: a point mass on a plane with six equally good goals.

The task of the paper's multimodality test (appendix "MultiGoal Setups"), after Haarnoja et al.
(2017). Its dynamics are written once, for a batch; the single environment is a batch of one.

Where the paper is silent, this module assumes:

- The position moves with the velocity of the step before; then the velocity changes (explicit
  Euler). There is no friction and no speed limit.
- An episode starts at rest, uniformly in ``[-7, 7]^2``: inside the walls at 8, with some room.
- "Check wall collisions" means that leaving the workspace ends the episode: a termination, without
  a penalty (what is lost is the reward of the steps that would have followed).
- Reaching a goal does not end the episode: the agent is paid for staying.
- The reward is that of the position after the step, and each term is multiplied by ``DT``. The
  paper's returns (8.79) are on this scale: at most 0.2 a step and 10 an episode.
- The action penalty is that of the action received, before it is clipped to the bounds. (SB3's
  algorithms clip to the bounds themselves, before the environment sees the action.)
- The goals' angles are 0, 60, ..., 300 degrees.
- Success is to end within ``SUCCESS_RADIUS`` of a goal; the paper has no such number.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sb3_policyflow.envs.multigoal.point_masses import (
    MAX_ACTION,
    MAX_EPISODE_STEPS,
    PointMasses,
)
from sb3_policyflow.envs.type_aliases import Float32Array, FloatArray, Info
from sb3_policyflow.envs.vector import GymVectorVecEnv, final_infos

METADATA: Info = {"render_modes": ["rgb_array"], "render_fps": 15}


def _spaces() -> tuple[gym.Space[Float32Array], gym.Space[Float32Array]]:
    """Observation and action space; new ones for each environment, as each has its own seed."""
    return (
        gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
        gym.spaces.Box(-MAX_ACTION, MAX_ACTION, (2,), np.float32),
    )


class MultiGoalEnv(gym.Env[Float32Array, Float32Array]):
    """``MultiGoal-v0``, one environment.

    Observation ``[x, y, v_x, v_y]``, action ``[a_x, a_y]`` in ``[-5, 5]``. ``info["is_success"]``
    says whether the point is within 1.0 of a goal. ``reset(options={"position": (x, y),
    "velocity": (v_x, v_y)})`` starts from a given state (either may be left out).

    The environment truncates itself. Under ``gymnasium.make``, whose time limit is a wrapper of the
    same length, an argument ``max_episode_steps`` can shorten an episode but not lengthen it.

    :param render_mode: ``None`` or ``"rgb_array"``.
    :param max_episode_steps: Steps after which an episode is truncated.
    """

    metadata = METADATA

    def __init__(
        self, render_mode: str | None = None, max_episode_steps: int = MAX_EPISODE_STEPS
    ) -> None:
        self.observation_space, self.action_space = _spaces()
        self.render_mode = render_mode
        self.points = PointMasses(1, max_episode_steps, keep_trails=render_mode is not None)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Float32Array, Info]:
        super().reset(seed=seed)
        self.points.start(self.np_random, options)
        return self.points.observations()[0], self._info()

    def step(self, action: Float32Array) -> tuple[Float32Array, float, bool, bool, Info]:
        rewards, terminated, truncated = self.points.step(np.asarray(action)[None])
        observation = self.points.observations()[0]
        return (
            observation,
            float(rewards[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            self._info(),
        )

    def render(self) -> NDArray[np.uint8] | None:
        return None if self.render_mode is None else self.points.draw(0)

    def _info(self) -> Info:
        return {"is_success": bool(self.points.is_success()[0])}


class MultiGoalState(NamedTuple):
    """All that the future of a ``MultiGoalVectorEnv`` depends on besides the actions."""

    states: FloatArray
    steps: NDArray[np.int64]
    trails: FloatArray
    generator: Mapping[str, Any]


class MultiGoalVectorEnv(gym.vector.VectorEnv[Float32Array, Float32Array, NDArray[Any]]):
    """``MultiGoal-v0``, ``num_envs`` environments in one batch of arrays.

    Same-step autoreset: when an episode ends, the next one's first observation is returned, and
    ``infos["final_obs"]`` and ``infos["final_info"]["is_success"]`` hold the end of the one before.
    All environments draw from one random generator.

    :param num_envs: Number of environments.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param max_episode_steps: Steps after which an episode is truncated.
    """

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        self.metadata = {**METADATA, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.points = PointMasses(num_envs, max_episode_steps, keep_trails=render_mode is not None)
        self.single_observation_space, self.single_action_space = _spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Float32Array, Info]:
        super().reset(seed=seed)
        self.points.start(self.np_random, options)
        return self.points.observations(), {}

    def step(
        self, actions: Float32Array
    ) -> tuple[Float32Array, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        rewards, terminated, truncated = self.points.step(actions)
        done = terminated | truncated
        infos: Info = {}
        if done.any():
            is_success = self.points.is_success() & done
            infos = {
                **final_infos(self.points.observations(), done),
                "final_info": {"is_success": is_success, "_is_success": done},
                "_final_info": done,
            }
            self.points.reset(np.flatnonzero(done), self.np_random)
        return self.points.observations(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        if self.render_mode is None:
            return None
        return tuple(self.points.draw(i) for i in range(self.num_envs))

    def get_state(self) -> MultiGoalState:
        """A copy of the points, counters and random generator."""
        points = self.points
        return MultiGoalState(
            points.states.copy(),
            points.steps.copy(),
            points.trails.copy(),
            self.np_random.bit_generator.state,
        )

    def set_state(self, state: MultiGoalState) -> None:
        """Continue from what ``get_state`` returned."""
        self.points.states[:] = state.states
        self.points.steps[:] = state.steps
        self.points.trails[:] = state.trails
        self.np_random.bit_generator.state = state.generator


class MultiGoalVecEnv(GymVectorVecEnv):
    """``MultiGoal-v0`` as an SB3 ``VecEnv``: thousands of environments in one process.

    Wrap it in ``VecMonitor`` for episode statistics. ``set_options`` takes the reset options of
    ``MultiGoalEnv``: one dictionary for all environments, where a value may also have one row for
    each, or a list with one dictionary for each.

    :param num_envs: Number of environments.
    :param seed: Seed of the first ``reset``; ``seed()`` sets another.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param max_episode_steps: Steps after which an episode is truncated.
    """

    env: MultiGoalVectorEnv

    def __init__(
        self,
        num_envs: int,
        seed: int | None = None,
        render_mode: str | None = None,
        max_episode_steps: int = MAX_EPISODE_STEPS,
    ) -> None:
        env = MultiGoalVectorEnv(num_envs, render_mode, max_episode_steps)
        super().__init__(env, batch_options=_stack_options)
        self.seed(seed)

    def get_state(self) -> MultiGoalState:
        """All that the future depends on besides the actions: points, counters, generator."""
        return self.env.get_state()

    def set_state(self, state: MultiGoalState) -> None:
        """Continue from what ``get_state`` returned, instead of ``reset``."""
        self.env.set_state(state)


def _stack_options(options: Sequence[Info]) -> Info:
    """One dictionary of reset options, with a row for each environment."""
    keys = set(options[0])
    if any(set(each) != keys for each in options):
        raise ValueError(
            "A list of reset options must have the same keys for all environments, not "
            f"{[sorted(each) for each in options]}."
        )
    return {key: np.stack([each[key] for each in options]) for key in keys}
