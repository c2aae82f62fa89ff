"""Environments in an algorithm of SB3: how they are found, wrapped and collected from.

Those of tensors too.
"""

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_policyflow.device.collection import DeviceCollection
from sb3_policyflow.envs.registration import ensure_registered
from sb3_policyflow.envs.tensor import TensorEnvAdapter, as_vec_env
from sb3_policyflow.resilience.collection import Loop


def registered(env: Any) -> Any:
    """An environment as the user gave it; an id that this package knows of is registered first.

    :param env: The environment, or its id.
    """
    if isinstance(env, str):
        ensure_registered(env)
    return env


def wrap(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """What SB3's ``_wrap_env`` does, for a :class:`~sb3_policyflow.envs.tensor.TensorVecEnv` too.

    :param env: The user's environment.
    :param verbose: Whether to say which wrappers are added.
    :param monitor_wrapper: Whether to add a ``Monitor`` to an environment that is not vectorized.
    """
    return BaseAlgorithm._wrap_env(as_vec_env(env), verbose, monitor_wrapper)


def collect(
    model: Any,
    loop: Loop,
    env: VecEnv,
    callback: BaseCallback,
    buffer: RolloutBuffer,
    n_steps: int,
) -> bool:
    """Collect one rollout, without leaving the device if the environment's steps are tensors.

    :param model: The algorithm.
    :param loop: SB3's, for all other environments; takes the arguments that follow.
    :param env: The training environment.
    :param callback: All callbacks.
    :param buffer: Gets the rollout.
    :param n_steps: Steps of each environment.
    :return: False if a callback has stopped the training.
    """
    found = tensors_behind(env)
    if found is None:
        return loop(env, callback, buffer, n_steps)
    return DeviceCollection(model, *found, callback, buffer).run(n_steps)


def tensors_behind(env: VecEnv) -> tuple[TensorEnvAdapter, VecNormalize | None] | None:
    """The environment of tensors, and the ``VecNormalize`` around it.

    :param env: The training environment.
    :return: None if it is of another kind, or in other wrappers, which need arrays.
    """
    normalize = env if isinstance(env, VecNormalize) else None
    inner = env if normalize is None else normalize.venv
    return (inner, normalize) if isinstance(inner, TensorEnvAdapter) else None
