"""A policy with all that stands around it in training, as one module of PyTorch."""

from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_policyflow.common.policies import FlowPolicy

Observations = th.Tensor | dict[str, th.Tensor]


class NormalizeObservation(nn.Module):
    """The normalization of observations by ``VecNormalize``, with its present statistics.

    clip((o - mean) / sqrt(var + epsilon), -clip_obs, clip_obs)

    Computed in double precision, as ``VecNormalize`` does.

    :param normalize: The wrapper, whose statistics are copied.
    :param key: Key of the observation, if the observations are a dictionary.
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(self, normalize: VecNormalize, key: str | None = None) -> None:
        super().__init__()
        statistics: Any = normalize.obs_rms if key is None else normalize.obs_rms[key]
        self.register_buffer("mean", th.as_tensor(statistics.mean, device="cpu"))
        std = np.sqrt(statistics.var + normalize.epsilon)
        self.register_buffer("std", th.as_tensor(std, device="cpu"))
        self.clip = float(normalize.clip_obs)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Normalize observations.

        :param observations: Observations of any shape (n, ...) and dtype.
        :return: Normalized observations in single precision, of the same shape.
        """
        normalized = (observations.double() - self.mean) / self.std
        return normalized.clamp(-self.clip, self.clip).float()


class PlainMish(nn.Module):
    """Mish, x tanh(log(1 + exp x)), of operators that every runtime can evaluate in advance."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Apply it to a tensor of any shape."""
        return x * nn.functional.softplus(x).tanh()


def _with_plain_mish(module: nn.Module) -> None:
    """Replace ``nn.Mish`` in a module; onnxruntime warns of each one whose input is constant."""
    for name, part in module.named_children():
        if isinstance(part, nn.Mish):
            setattr(module, name, PlainMish())
        _with_plain_mish(part)


class ActionModule(nn.Module):
    """Maps observations to actions, as ``predict(deterministic=True)`` does.

    Applies normalization, preprocessing, all steps of the flow or of the denoising chain, and the
    bounds of the actions. Inputs and outputs are tensors, and nothing is drawn at random.

    :param policy: The policy, which is copied.
    :param normalize: The ``VecNormalize`` that the policy was trained with. Without it the module
        takes observations that are normalized already.
    :param space: Space of the environment's own observations, for their dtype; by default that of
        the environment that ``normalize`` wraps, or of the policy.
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(
        self,
        policy: FlowPolicy,
        normalize: VecNormalize | None = None,
        space: spaces.Space[Any] | None = None,
    ) -> None:
        super().__init__()
        self.policy = deepcopy(getattr(policy, "_orig_mod", policy)).cpu()
        self.policy.set_training_mode(False)
        if self.policy.deterministic_action == "drawn":
            self.policy.deterministic_action = "mode"
        _with_plain_mish(self.policy)
        wrapped = None if normalize is None else vars(normalize).get("venv")
        self.raw_space = space if wrapped is None else wrapped.observation_space
        self.normalizers = nn.ModuleDict(_normalizers(self.policy.observation_space, normalize))
        box = self.policy.action_space
        assert isinstance(box, spaces.Box)
        for name, bound in (("low", box.low), ("high", box.high)):
            self.register_buffer(name, th.as_tensor(bound, dtype=th.float32, device="cpu"))

    def forward(self, observations: Observations, latents: th.Tensor | None = None) -> th.Tensor:
        """Compute actions.

        :param observations: Observations of the environment, with images channels first: a tensor
            (n, ...), or a dictionary of tensors.
        :param latents: z, where the flow starts, shape (n, action_dim); those of the deterministic
            action if not given. Drawn ones are normal with standard deviation
            ``policy.latent_scale``.
        :return: Actions within their bounds, shape (n, ...).
        """
        features = self.policy.actor_features(self._normalized(observations))
        if latents is None:
            _, actions = self.policy.draw_endpoints(features, deterministic=True)
        else:
            actions = self.policy.transport(latents, features)
        actions = actions.reshape(-1, *self.low.shape)
        if self.policy.squash_output:
            actions = self.low + 0.5 * (actions + 1.0) * (self.high - self.low)
        return actions.clamp(self.low, self.high)

    def _normalized(self, observations: Observations) -> Observations:
        if isinstance(observations, dict):
            return {
                key: self.normalizers[key](values) if key in self.normalizers else values
                for key, values in observations.items()
            }
        return self.normalizers["all"](observations) if self.normalizers else observations

    def example(self, latents: bool = False) -> tuple[Any, ...]:
        """Arguments of :meth:`forward` for a batch of two, filled with zeros.

        :param latents: Whether to include latents.
        """
        space = self.policy.observation_space
        if isinstance(space, spaces.Dict):
            observations: Any = {key: self._zeros(key, part) for key, part in space.items()}
        else:
            observations = self._zeros("all", space)
        if not latents:
            return (observations,)
        return observations, th.zeros(2, self.policy.action_dim, dtype=th.float32, device="cpu")

    def _zeros(self, key: str, space: spaces.Space[Any]) -> th.Tensor:
        """Zeros of the dtype that the input has, which is the environment's."""
        assert space.shape is not None
        dtype = space.dtype
        if key in self.normalizers:  # the policy's space is that of normalized observations
            raw = self.raw_space[key] if isinstance(self.raw_space, spaces.Dict) else self.raw_space
            dtype = np.dtype(np.float32) if raw is None else raw.dtype
        return th.as_tensor(np.zeros((2, *space.shape), dtype=dtype), device="cpu")


def _normalizers(
    space: spaces.Space[Any], normalize: VecNormalize | None
) -> dict[str, NormalizeObservation]:
    if normalize is None or not normalize.norm_obs:
        return {}
    if isinstance(space, spaces.Dict):
        keys = normalize.norm_obs_keys or []
        return {key: NormalizeObservation(normalize, key) for key in keys}
    return {"all": NormalizeObservation(normalize)}
