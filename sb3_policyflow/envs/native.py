"""Environments that step many copies at once, in place of ``DummyVecEnv``."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from sb3_policyflow.envs.vector import GymVectorVecEnv

EnvFn = Callable[[], gym.Env[Any, Any]]


def has_own_vectorization(spec: EnvSpec, of_this_package: bool = False) -> bool:
    """Whether an environment says how to step many of its kind.

    :param spec: The environment's registration.
    :param of_this_package: Whether only this package's environments count.
    """
    if spec.vector_entry_point is None:
        return False
    return not of_this_package or str(spec.entry_point).startswith("sb3_policyflow.")


def make_native_vec_env(env_fns: list[EnvFn], **kwargs: Any) -> VecEnv:
    """Make one batch of environments in place of single ones, with one monitor file.

    The single ones are as SB3's ``make_vec_env`` makes them. The result is a ``DummyVecEnv`` of
    them if the batch would differ: if wrappers are around them, or if the batch does not reset an
    environment in the step in which its episode ends.

    :param env_fns: What makes each environment; all are alike.
    :param kwargs: For ``DummyVecEnv``.
    """
    sample = env_fns[0]()
    sample.close()
    venv = _vectorize(sample, len(env_fns)) if isinstance(sample, Monitor) else None
    return venv or DummyVecEnv(env_fns, **kwargs)


def _vectorize(sample: Monitor, num_envs: int) -> VecEnv | None:
    """A batch of environments like the sample, or None if it would differ from single ones."""
    spec = sample.env.spec  # with the user's env_kwargs
    assert spec is not None
    if spec.additional_wrappers:
        return None
    vector_env = gym.make_vec(spec, num_envs, vectorization_mode="vector_entry_point")
    if vector_env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        vector_env.close()
        return None
    # Record episodes in the file that the sample would have written to.
    writer = sample.results_writer
    filename = None if writer is None else str(writer.file_handler.name)
    return VecMonitor(GymVectorVecEnv(vector_env), filename, sample.info_keywords)
