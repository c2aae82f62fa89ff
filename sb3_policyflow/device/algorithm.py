"""An on-policy algorithm that collects from environments of tensors without leaving the device."""

from typing import Any

from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_policyflow.device.collection import DeviceCollection, tensors_behind
from sb3_policyflow.envs.tensor import as_vec_env
from sb3_policyflow.resilience.algorithm import ResilientOnPolicyAlgorithm


class DeviceOnPolicyAlgorithm(ResilientOnPolicyAlgorithm):
    """A resilient algorithm that also takes a :class:`~sb3_policyflow.envs.tensor.TensorVecEnv`.

    Only the loop that collects a rollout is another one, see
    :class:`~sb3_policyflow.device.collection.DeviceCollection`.
    """

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return ResilientOnPolicyAlgorithm._wrap_env(as_vec_env(env), verbose, monitor_wrapper)

    def _collect(
        self, env: VecEnv, callback: BaseCallback, buffer: RolloutBuffer, n_steps: int
    ) -> bool:
        found = tensors_behind(env)
        if found is None:
            return super()._collect(env, callback, buffer, n_steps)
        return DeviceCollection(self, *found, callback, buffer).run(n_steps)
