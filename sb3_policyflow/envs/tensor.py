"""Environments whose batch of steps is tensors on one device."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import gymnasium as gym
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from sb3_policyflow.envs.type_aliases import Info
from sb3_policyflow.envs.vector import row

TensorObs = Any
"""A tensor (n, ...), or a dictionary of such tensors."""


class TensorStep(NamedTuple):
    """What a step of n environments returns, on their device.

    ``observations`` (n, ...) are the next episode's first where an episode has ended. ``rewards``
    (n,) are float32; ``terminated`` and ``truncated`` (n,) say whether the task or a time limit has
    ended an episode. ``ended`` (k,) has the indices of the episodes that have ended, in order, and
    ``final_observations`` (k, ...) their last observations. ``successes`` (k,), if there are any,
    say whether each was a success.
    """

    observations: TensorObs
    rewards: th.Tensor
    terminated: th.Tensor
    truncated: th.Tensor
    ended: th.Tensor
    final_observations: TensorObs
    successes: th.Tensor | None = None


@runtime_checkable
class TensorVecEnv(Protocol):
    """A batch of environments that takes and returns tensors on one device.

    What it has returned it does not change later, and the caller does not either.
    An environment may also have ``seed(seed)``, whose seed is for the next ``reset``, and
    ``close()``.
    """

    num_envs: int
    observation_space: gym.Space[Any]
    """Of one environment."""
    action_space: gym.Space[Any]
    device: th.device

    def reset(self) -> TensorObs:
        """Begin an episode in each environment, and return the first observations."""

    def step(self, actions: th.Tensor) -> TensorStep:
        """Advance each environment by one step, and begin another episode where one has ended.

        :param actions: Shape (n, ...), within the bounds of the space. They must not be changed.
        """


def map_observations(function: Callable[[Any], Any], observations: Any) -> Any:
    """Apply a function to observations, or to each in a dictionary of them."""
    if isinstance(observations, dict):
        return {key: function(values) for key, values in observations.items()}
    return function(observations)


class LazyInfos(Sequence[Info]):
    """SB3's infos of one step, each made when it is asked for: few of n are not empty.

    :param step: The step.
    :param returns: The sums of the rewards of the episodes that have ended, shape (k,).
    :param lengths: Their lengths, shape (k,).
    """

    def __init__(
        self,
        step: TensorStep,
        returns: th.Tensor | None = None,
        lengths: th.Tensor | None = None,
    ) -> None:
        self._step = step
        self._episodes = None if returns is None or lengths is None else (returns, lengths)
        self._made: dict[int, Info] | None = None

    def __len__(self) -> int:
        return len(self._step.rewards)

    def __getitem__(self, index: Any) -> Any:
        if self._made is None:
            self._made = dict(self._ended())
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self._made.get(range(len(self))[index], {})

    def _ended(self) -> Iterator[tuple[int, Info]]:
        step = self._step
        limits = (step.truncated & ~step.terminated)[step.ended].tolist()
        finals = map_observations(lambda values: values.cpu().numpy(), step.final_observations)
        successes = None if step.successes is None else step.successes.tolist()
        for k, index in enumerate(step.ended.tolist()):
            final = row(finals, k)
            info: Info = {"terminal_observation": final, "TimeLimit.truncated": limits[k]}
            if successes is not None:
                info["is_success"] = successes[k]
            if self._episodes is not None:
                info["episode"] = {"r": float(self._episodes[0][k]), "l": int(self._episodes[1][k])}
            yield index, info


class TensorEnvAdapter(VecEnv):
    """A :class:`TensorVecEnv` as SB3's ``VecEnv``.

    The algorithms of this package collect rollouts from ``env`` itself, without arrays. For
    everything else, such as ``evaluate_policy``, this is an ordinary ``VecEnv`` of NumPy arrays.

    :param env: The environment.
    """

    def __init__(self, env: TensorVecEnv) -> None:
        self.env = env
        self.episodes = th.zeros(2, env.num_envs, device=env.device)
        """Sum of the rewards and length of each episode so far, kept where rollouts are tensors."""
        self._actions: th.Tensor | None = None
        super().__init__(env.num_envs, env.observation_space, env.action_space)

    def reset(self) -> VecEnvObs:
        seed = self._seeds[0]
        if seed is not None and hasattr(self.env, "seed"):
            self.env.seed(seed)
        self._reset_seeds()
        self._reset_options()
        self.episodes.zero_()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        observations: VecEnvObs = _to_numpy(self.env.reset())
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = th.as_tensor(actions, device=self.env.device)

    def step_wait(self) -> VecEnvStepReturn:
        assert self._actions is not None
        step = self.env.step(self._actions)
        lazy = LazyInfos(step)
        dones = (step.terminated | step.truncated).cpu().numpy()
        # Wrappers write to them, so that each environment needs one of its own.
        infos = [{**info} for info in lazy]
        return _to_numpy(step.observations), step.rewards.cpu().numpy().copy(), dones, infos

    def close(self) -> None:
        if hasattr(self.env, "close"):
            self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.env, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        self._require_all(indices, f"set {attr_name!r}")
        setattr(self.env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        self._require_all(indices, f"call {method_name!r}")
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(
        self,
        wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]],  # noqa: ARG002
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))

    def _require_all(self, indices: VecEnvIndices, what: str) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"{self.env} simulates its environments as one batch: {what} for all of them "
                "(indices=None), not for some."
            )


def as_vec_env(env: Any) -> Any:
    """A ``VecEnv`` of an environment of tensors; anything else is returned as it is."""
    # Other environments are not asked for attributes: a wrapper may not be able to answer yet.
    is_tensor_env = not isinstance(env, (VecEnv, gym.Env)) and isinstance(env, TensorVecEnv)
    return TensorEnvAdapter(env) if is_tensor_env else env


def _to_numpy(observations: TensorObs) -> Any:
    """Copies, which the environment does not change."""
    return map_observations(lambda values: values.cpu().numpy().copy(), observations)
