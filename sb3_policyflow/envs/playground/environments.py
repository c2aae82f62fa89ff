"""Tasks of MuJoCo Playground (Zakka et al., 2025), simulated by MuJoCo MJX on JAX.

The paper trains on ten of them, dm_control's tasks as Playground has them; the others work too.
They need the extra ``playground``, and JAX is imported when an environment is made. Observations
and rewards are those of Playground's own step function. What is added:

- A time limit, the ``episode_length`` of the task's configuration, which is a truncation. Only the
  task itself terminates an episode: in the control suite, if the simulation breaks (a value becomes
  NaN). The reward of that step is 0 here.
- A new initial state for each episode. By default, Playground's training wrapper returns each
  environment to the first state that it had.
- Bounds of the actions. The environments do not clip; SB3's algorithms do before they act.

A step is one compiled function for all environments. Compiling it takes from ten seconds to a
minute, once for each number of environments; JAX_COMPILATION_CACHE_DIR in the environment names a
folder that keeps it between runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sb3_policyflow.envs.playground.tasks import load_task
from sb3_policyflow.envs.type_aliases import Float32Array, Info
from sb3_policyflow.envs.vector import GymVectorVecEnv, final_infos, row

if TYPE_CHECKING:
    from sb3_policyflow.envs.playground.batch import Overrides, PlaygroundBatch
    from sb3_policyflow.envs.playground.camera import Camera

METADATA: Info = {"render_modes": ["rgb_array"]}

STAGGER = "init_at_random_ep_len"
"""The reset option of vectorized tasks."""


class PlaygroundEnv(gym.Env[Any, Float32Array]):
    """``Playground/NAME-v0``, one environment: a batch of one.

    For training, use ``PlaygroundVectorEnv``: its step takes little longer.

    :param task: Name of the task, for instance ``"CheetahRun"``.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param max_episode_steps: Steps after which an episode is truncated; None for the task's own.
        That of ``gymnasium.make`` is a wrapper's, and can only end episodes sooner:
        ``config_overrides={"episode_length": ...}`` sets any limit.
    :param config_overrides: Changes to Playground's configuration of the task, such as
        ``{"impl": "warp", "sim_dt": 0.005}``; nested, or with dots in its keys.
    """

    metadata = METADATA

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        config_overrides: Overrides | None = None,
    ) -> None:
        self.batch = load_task(task, 1, max_episode_steps, config_overrides)
        self.metadata = {**METADATA, "render_fps": round(1 / self.batch.env.dt)}
        self.observation_space = self.batch.observation_space()
        self.action_space = self.batch.action_space()
        self.render_mode = render_mode
        self._camera = _camera(self.batch, render_mode)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        super().reset(seed=seed)
        _refuse(options)
        self.batch.reset(_draw_seed(self.np_random))
        return row(to_numpy(self.batch.state.obs), 0), {}

    def step(self, action: Float32Array) -> tuple[Any, float, bool, bool, Info]:
        self.batch.step(np.asarray(action, np.float32)[None])
        return (
            row(to_numpy(self.batch.state.obs), 0),
            float(self.batch.state.reward[0]),
            bool(self.batch.terminated[0]),
            bool(self.batch.truncated[0]),
            {},
        )

    def render(self) -> NDArray[np.uint8] | None:
        return None if self._camera is None else self._camera.picture(self.batch.state.data, 0)

    def close(self) -> None:
        if self._camera is not None:
            self._camera.close()


class TensorStep(NamedTuple):
    """What ``PlaygroundVectorEnv.step_tensors`` returns, for n environments.

    Observations (n, ...), which are the next episode's first where an episode has ended; rewards
    (n,); whether the task or the time limit has ended the episode, (n,) each, both on the CPU; and
    the observations before any reset. Observations are dictionaries if the space is a ``Dict``.
    """

    observations: Any
    rewards: th.Tensor
    terminated: th.Tensor
    truncated: th.Tensor
    final_observations: Any


class PlaygroundVectorEnv(gym.vector.VectorEnv[Any, Float32Array, NDArray[Any]]):
    """``Playground/NAME-v0``, ``num_envs`` environments in one batch.

    Same-step autoreset: when an episode ends, the next one's first observation is returned, and
    ``infos["final_obs"]`` holds the last of the one before. Each episode starts from a new state.

    ``step`` returns NumPy arrays, as Gymnasium and SB3 need them. ``reset_tensors`` and
    ``step_tensors`` do the same with torch tensors that share JAX's memory, on a CPU or a GPU:
    only the flags of ended episodes are copied to the host.

    ``reset(options={"init_at_random_ep_len": True})`` starts each environment at a random step of
    its time limit, so that from then on their episodes end at different times (the option of this
    name is RSL-RL's).

    :param task: Name of the task, for instance ``"CheetahRun"``.
    :param num_envs: Number of environments.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :param max_episode_steps: Steps after which an episode is truncated; None for the task's own.
    :param config_overrides: Changes to Playground's configuration of the task.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        config_overrides: Overrides | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.batch = load_task(task, num_envs, max_episode_steps, config_overrides)
        self.metadata = {
            **METADATA,
            "render_fps": round(1 / self.batch.env.dt),
            "autoreset_mode": AutoresetMode.SAME_STEP,
        }
        self.single_observation_space = self.batch.observation_space()
        self.single_action_space = self.batch.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._camera = _camera(self.batch, render_mode)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        stagger = _wants_stagger(options)
        self._start(seed)
        if stagger:
            self.batch.stagger(self.np_random)
        return to_numpy(self.batch.state.obs), {}

    def step(
        self, actions: Float32Array
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        final, rewards, terminated, truncated = self._advance(np.asarray(actions, np.float32))
        done = terminated | truncated
        infos = final_infos(to_numpy(final), done) if done.any() else {}
        return to_numpy(self.batch.state.obs), to_numpy(rewards), terminated, truncated, infos

    def reset_tensors(self, seed: int | None = None) -> Any:
        """``reset``, with a tensor or a dictionary of tensors. Do not write to them."""
        self._start(seed)
        return self.batch.to_torch(self.batch.state.obs)

    def step_tensors(self, actions: th.Tensor) -> TensorStep:
        """``step``, with tensors. Do not write to them."""
        final, rewards, *flags = self._advance(self.batch.from_torch(actions))
        to_torch = self.batch.to_torch
        terminated, truncated = (th.from_numpy(flag) for flag in flags)
        return TensorStep(
            to_torch(self.batch.state.obs),
            to_torch(rewards),
            terminated,
            truncated,
            to_torch(final),
        )

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        if self._camera is None:
            return None
        data = self.batch.state.data
        return tuple(self._camera.picture(data, i) for i in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:
        if self._camera is not None:
            self._camera.close()

    def _start(self, seed: int | None) -> None:
        super().reset(seed=seed)
        self.batch.reset(_draw_seed(self.np_random))

    def _advance(self, actions: Any) -> tuple[Any, Any, NDArray[np.bool_], NDArray[np.bool_]]:
        """Step, and reset where an episode has ended.

        :return: Observations before any reset and rewards on JAX's device, and the two flags.
        """
        batch = self.batch
        if actions.shape != self.action_space.shape:
            raise ValueError(
                f"{self} takes actions of shape {self.action_space.shape}, not {actions.shape}."
            )
        batch.step(actions)
        result = batch.state.obs, batch.state.reward, batch.terminated, batch.truncated
        done = result[2] | result[3]
        if done.any():
            batch.renew(done, _draw_seed(self.np_random))
        return result


class PlaygroundVecEnv(GymVectorVecEnv):
    """A task of MuJoCo Playground as an SB3 ``VecEnv``; wrap it in ``VecMonitor`` for statistics.

    Where a task observes several things, for instance ``"state"`` and ``"privileged_state"``,
    observations are dictionaries; SB3's ``VecExtractDictObs`` leaves one of them.

    ``set_options({"init_at_random_ep_len": True})`` is for the next ``reset`` alone, as are all
    reset options in SB3.

    :param task: Name of the task, for instance ``"CheetahRun"``.
    :param num_envs: Number of environments.
    :param seed: Seed of the first ``reset``; ``seed()`` sets another.
    :param options: Further arguments of ``PlaygroundVectorEnv``.
    """

    env: PlaygroundVectorEnv

    def __init__(self, task: str, num_envs: int, seed: int | None = None, **options: Any) -> None:
        super().__init__(PlaygroundVectorEnv(task, num_envs, **options))
        self.seed(seed)


def to_numpy(arrays: Any) -> Any:
    """Copies of arrays, or of a dictionary of them, as float32 that may be written to."""
    if isinstance(arrays, Mapping):
        return {key: to_numpy(array) for key, array in arrays.items()}
    return np.array(arrays, np.float32)


def _draw_seed(generator: np.random.Generator) -> int:
    return int(generator.integers(2**32))


def _refuse(options: Info | None) -> None:
    if options:
        raise ValueError(
            "Tasks of MuJoCo Playground draw their own initial states: reset takes no options "
            f"{options}."
        )


def _wants_stagger(options: Info | None) -> bool:
    """Whether the options have ``init_at_random_ep_len``; others are refused."""
    others = dict(options or {})
    stagger = others.pop(STAGGER, False)
    _refuse(others)
    if not isinstance(stagger, bool):
        raise ValueError(f"{STAGGER} must be True or False, got {stagger!r}.")
    return stagger


def _camera(batch: PlaygroundBatch, render_mode: str | None) -> Camera | None:
    if render_mode is None:
        return None
    from sb3_policyflow.envs.playground.camera import Camera

    return Camera(batch.env.mj_model)
