"""Environments of MuJoCo Playground in one batch of JAX arrays.

This module imports JAX. ``sb3_policyflow.envs.playground``, which has the environments, imports it
when one of them is made.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import torch as th
from mujoco_playground import dm_control_suite, locomotion, manipulation, registry
from numpy.typing import NDArray
from torch.utils.dlpack import from_dlpack

Overrides = Mapping[str, Any]
Tree = Any
"""An array, or dictionaries and dataclasses of arrays."""


def all_tasks() -> tuple[str, ...]:
    """Names of Playground's tasks, those included that a user has registered with it."""
    suites = (dm_control_suite, locomotion, manipulation)
    return tuple(name for suite in suites for name in suite.ALL_ENVS)


def task_config(task: str, overrides: Overrides) -> Any:
    """Playground's configuration of a task, with ``impl="jax"`` where JAX has a CPU only.

    Playground's default there, MuJoCo Warp, is slower on a CPU by a factor of five or more.

    :param task: Name of the task.
    :param overrides: Changes to the configuration, nested or with dots in their keys.
    :raises ValueError: If a key is not in the configuration.
    """
    config = registry.get_default_config(task)
    if "impl" in config and jax.default_backend() == "cpu":
        config.impl = "jax"
    changes = _flatten(overrides)
    for key in changes:
        _require_setting(task, config.to_dict(), key)
    config.update_from_flattened_dict(changes)
    return config


def _flatten(overrides: Overrides) -> dict[str, Any]:
    """Nested dictionaries as one, with dots in its keys.

    >>> _flatten({"sim_dt": 0.01, "noise": {"level": 2, "scales.joint": 3}})
    {'sim_dt': 0.01, 'noise.level': 2, 'noise.scales.joint': 3}
    """
    flat: dict[str, Any] = {}
    for key, value in overrides.items():
        if isinstance(value, Mapping):
            flat.update({f"{key}.{name}": leaf for name, leaf in _flatten(value).items()})
        else:
            flat[key] = value
    return flat


def _require_setting(task: str, known: Any, key: str) -> None:
    """Check that a key with dots is in nested settings: the engine would add it, and ignore it.

    :raises ValueError: If it is not, with the names of the settings.
    """
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if not isinstance(known, Mapping) or part not in known:
            there = ", ".join(sorted(known)) if isinstance(known, Mapping) else "no settings in it"
            raise ValueError(
                f"Playground's {task} has no setting {key!r} that config_overrides could change: "
                f"{'.'.join(parts[:depth]) or 'it'} has {there}."
            )
        known = known[part]


class PlaygroundBatch:
    """``num_envs`` environments of one task, stepped by one compiled function.

    Arrays are JAX's and stay on its device; only the flags of ended episodes come to the host. An
    environment is reset by ``reset`` and ``renew`` only. A broken simulation, whose episode
    Playground ends because a value has become NaN, has a reward of 0.

    :param task: Name of the task.
    :param num_envs: Number of environments.
    :param max_episode_steps: Time limit; None for the task's ``episode_length``.
    :param overrides: Changes to the task's configuration.
    :raises ValueError: If a number is less than 1, or an override is not known.
    """

    def __init__(
        self, task: str, num_envs: int, max_episode_steps: int | None, overrides: Overrides
    ) -> None:
        config = task_config(task, overrides)
        limit = config.episode_length if max_episode_steps is None else max_episode_steps
        if num_envs < 1 or limit < 1:
            raise ValueError(
                f"num_envs and max_episode_steps must be at least 1, not {num_envs} and {limit}."
            )
        self.env = registry.load(task, config=config)
        self.num_envs = num_envs
        self.max_episode_steps = int(limit)
        self.bounds = self._action_bounds(task)
        self._state: Tree = None
        self._device = jax.devices()[0]
        self._action_repeat = int(config.action_repeat)
        self._steps: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        self._reset = jax.jit(self._start)
        self._step = jax.jit(self._advance)
        self._select = jax.jit(self._replace)

    @property
    def state(self) -> Tree:
        """Playground's own state; ``obs`` and ``reward`` are those of the last step.

        :raises ResetNeeded: Before the first ``reset``.
        """
        if self._state is None:
            raise gym.error.ResetNeeded("Call reset before the first step.")
        return self._state

    def reset(self, seed: int) -> None:
        """Reset all environments, each to an initial state of its own."""
        self._state = self._draw_states(seed)
        self._steps[:] = 0

    def stagger(self, generator: np.random.Generator) -> None:
        """Let each environment's time limit count from a random step, to end at different times."""
        self._steps[:] = generator.integers(self.max_episode_steps, size=len(self._steps))

    def step(self, actions: Tree) -> None:
        """Advance all environments.

        :param actions: Float32, shape (num_envs, action_dim).
        """
        self._state = self._step(self.state, jax.device_put(actions, self._device))
        self._steps += self._action_repeat

    def renew(self, which: NDArray[np.bool_], seed: int) -> None:
        """Reset some environments to new initial states.

        States are drawn for all environments and used where needed: the shape is fixed, so this is
        compiled once. It costs a batched reset, in those steps in which an episode ends.

        :param which: Which environments, shape (num_envs,).
        :param seed: Seed of the initial states.
        """
        self._state = self._select(which, self._draw_states(seed), self.state)
        self._steps[which] = 0

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """Whether each task has ended, shape (num_envs,)."""
        return np.asarray(self.state.done) > 0

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """Whether each environment is at its time limit, shape (num_envs,)."""
        return self._steps >= self.max_episode_steps

    def observation_space(self) -> gym.Space[Any]:
        """Of one environment: a ``Box``, or a ``Dict`` of them where the task has several."""
        state = jax.eval_shape(self.env.reset, jax.random.PRNGKey(0))
        if not isinstance(state.obs, Mapping):
            return _unbounded(state.obs)
        return gym.spaces.Dict({key: _unbounded(leaf) for key, leaf in state.obs.items()})

    def action_space(self) -> gym.Space[Any]:
        """Of one environment."""
        low, high = self.bounds.T.astype(np.float32)
        return gym.spaces.Box(low, high, dtype=np.float32)

    def to_torch(self, arrays: Tree) -> Any:
        """Arrays, or a dictionary of them, as tensors.

        They share memory if torch can use the device that JAX has them on; if it cannot, they are
        copied to the CPU.
        """
        if self._device.platform == "cpu" or th.cuda.is_available():
            return jax.tree.map(from_dlpack, arrays)
        return jax.tree.map(lambda array: th.from_numpy(np.array(array)), arrays)

    def from_torch(self, actions: th.Tensor) -> Tree:
        """Actions as an array, which shares their memory if JAX can use their device."""
        actions = actions.detach().contiguous().float()
        return jax.dlpack.from_dlpack(actions.cpu() if self._device.platform == "cpu" else actions)

    def _action_bounds(self, task: str) -> NDArray[np.float64]:
        """Lower and upper bounds, shape (action_dim, 2).

        In the control suite actions are the actuators' controls, elsewhere offsets that Playground
        trains within [-1, 1].
        """
        if task in dm_control_suite.ALL_ENVS:
            return np.array(self.env.mj_model.actuator_ctrlrange)
        return np.tile([-1.0, 1.0], (self.env.action_size, 1))

    def _draw_states(self, seed: int) -> Tree:
        # JAX compiles again if an array is bound to a device in one call and not in the other.
        return self._reset(jax.device_put(np.uint32(seed), self._device))

    def _start(self, seed: Tree) -> Tree:
        keys = jax.random.split(jax.random.PRNGKey(seed), self.num_envs)
        state = jax.vmap(self.env.reset)(keys)
        # With the types that a step returns, or the first step would be compiled separately.
        actions = jnp.zeros((self.num_envs, self.env.action_size), jnp.float32)
        after = jax.eval_shape(self._advance, state, actions)
        return jax.tree.map(lambda leaf, like: jnp.asarray(leaf, like.dtype), state, after)

    def _advance(self, state: Tree, actions: Tree) -> Tree:
        state, reward = self._advance_once(state, actions)
        for _ in range(self._action_repeat - 1):
            has_ended = state.done > 0
            after, more = self._advance_once(state, actions)
            state = self._replace(has_ended, state, after)
            reward = reward + jnp.where(has_ended, 0, more)
        # An explicit dtype is "strong" in JAX: with a weak one the next step is compiled again.
        return jax.tree.map(
            lambda leaf: jnp.asarray(leaf, leaf.dtype), state.replace(reward=reward)
        )

    def _advance_once(self, state: Tree, actions: Tree) -> tuple[Tree, Tree]:
        """The next states, and rewards without those of broken simulations."""
        state = jax.vmap(self.env.step)(state, actions)
        is_broken = (state.done > 0) & jnp.isnan(state.reward)
        return state, jnp.where(is_broken, 0, state.reward)

    def _replace(self, which: Tree, fresh: Tree, state: Tree) -> Tree:
        def replace(new: Tree, old: Tree) -> Tree:
            # MuJoCo Warp shares some arrays between environments, such as its list of contacts.
            if old.shape[:1] != which.shape:
                return old
            return jnp.where(which.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

        return jax.tree.map(replace, fresh, state)


def _unbounded(leaf: Tree) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, leaf.shape, np.float32)
