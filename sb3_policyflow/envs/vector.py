"""Gymnasium vector environments as Stable-Baselines3 vectorized environments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

Info = dict[str, Any]


def unbatch_infos(infos: Info, num_envs: int) -> list[Info]:
    """One dictionary per environment out of Gymnasium's dictionary of arrays.

    Environment ``i`` gets ``key`` if the mask ``_key`` holds there, or if there is no mask.
    A nested dictionary is treated the same way; numbers become Python numbers.

    >>> unbatch_infos({"x": np.array([1, 0]), "_x": np.array([True, False])}, 2)
    [{'x': 1}, {}]
    """
    rows: list[Info] = [{} for _ in range(num_envs)]
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        items = _unbatch(values, num_envs)
        for i in np.flatnonzero(infos.get(f"_{key}", np.ones(num_envs, dtype=bool))).tolist():
            rows[i][key] = items[i]
    return rows


def _unbatch(values: Any, num_envs: int) -> Sequence[Any]:
    if isinstance(values, dict):
        return unbatch_infos(values, num_envs)
    array = np.asarray(values)
    return array.tolist() if array.ndim == 1 else list(array)


class GymVectorVecEnv(VecEnv):
    """Any Gymnasium ``VectorEnv`` with same-step autoreset, as an SB3 ``VecEnv``.

    Episode ends look as they do under ``DummyVecEnv``: the returned observation is the next
    episode's first, ``terminal_observation`` the last of the one that ended, and
    ``TimeLimit.truncated`` is true if it was truncated and not terminated.

    ``seed(n)`` hands ``n`` to the next ``reset`` of the vector environment, which derives one
    stream per environment from it, or draws for all of them from a single stream, as it sees fit.

    If the vector environment holds sub-environments in ``envs`` (as ``SyncVectorEnv`` does),
    ``get_attr``, ``set_attr``, ``env_method`` and ``env_is_wrapped`` reach each of them. Otherwise
    they act on the batch: the value is the same for every environment, and only all can be set.

    :param env: the vector environment
    :raises ValueError: if ``env`` does not reset in the step in which an episode ends
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        _require_same_step(env)
        self.env = env
        self.spec = env.spec  # VecMonitor names the environment in its file
        self._actions: NDArray[Any] | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        # SB3 keeps the modes only, and its VecVideoRecorder wants to know the frames per second.
        self.metadata = {**env.metadata, **self.metadata}

    def reset(self) -> VecEnvObs:
        observations: VecEnvObs
        observations, infos = self.env.reset(seed=self._seeds[0], options=self._shared_options())
        self.reset_infos = unbatch_infos(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        dones = terminated | truncated
        rows = unbatch_infos(infos, self.num_envs)
        for i in np.flatnonzero(dones).tolist():
            rows[i] = self._end_episode(i, rows[i])
        for row, timed_out in zip(rows, (truncated & ~terminated).tolist(), strict=True):
            row["TimeLimit.truncated"] = timed_out
        return observations, rewards.astype(np.float32), dones, rows

    def _end_episode(self, index: int, info: Info) -> Info:
        """The ended episode's last info; what else the vector environment said is of the next."""
        terminal_observation = info.pop("final_obs")
        last_info = info.pop("final_info", {})
        self.reset_infos[index] = info
        return {**last_info, "terminal_observation": terminal_observation}

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        frames: Any = self.env.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        if self._sub_envs is not None:
            return [self._sub_envs[i].get_wrapper_attr(attr_name) for i in self._at(indices)]
        single = f"single_{attr_name}" if attr_name.endswith("_space") else attr_name
        return [self._batch_attr(single)] * len(self._at(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if self._sub_envs is not None:
            for i in self._at(indices):
                setattr(self._sub_envs[i], attr_name, value)
        else:
            self._require_all(indices, f"set {attr_name!r}")
            setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        if self._sub_envs is not None:
            methods = self.get_attr(method_name, indices)
            return [method(*method_args, **method_kwargs) for method in methods]
        self._require_all(indices, f"call {method_name!r}")
        result = self._batch_attr(method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        if self._sub_envs is None:
            return [False] * len(self._at(indices))
        return [is_wrapped(self._sub_envs[i], wrapper_class) for i in self._at(indices)]

    @property
    def _sub_envs(self) -> Sequence[gym.Env[Any, Any]] | None:
        return getattr(self.env.unwrapped, "envs", None)

    def _batch_attr(self, name: str) -> Any:
        return getattr(self.env if hasattr(self.env, name) else self.env.unwrapped, name)

    def _at(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))

    def _require_all(self, indices: VecEnvIndices, what: str) -> None:
        if sorted(self._at(indices)) != list(range(self.num_envs)):
            raise ValueError(
                f"{self.env} simulates its environments as one batch: "
                f"{what} for all of them (indices=None), not for some."
            )

    def _shared_options(self) -> Info | None:
        first = self._options[0]
        if all(options is first for options in self._options):
            return first or None
        if not any(self._options):
            return None
        return self._batch_options(self._options)

    def _batch_options(self, options: Sequence[Info]) -> Info:
        """One dictionary that stands for different options per environment."""
        del options
        raise ValueError(
            f"{self.env} takes one dictionary of reset options for all its environments: "
            "call set_options with a dict, not a list."
        )


def _require_same_step(env: VectorEnv[Any, Any, Any]) -> None:
    mode = env.metadata.get("autoreset_mode")
    if mode is not AutoresetMode.SAME_STEP:
        raise ValueError(
            f"SB3 resets an environment in the step that ends its episode, but {env} has {mode}: "
            "create it with autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP "
            "(for gymnasium.make_vec: vector_kwargs={'autoreset_mode': ...})."
        )
