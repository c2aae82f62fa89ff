"""Export of policies to files that run without this package: ONNX, or torch alone.

.. code-block:: bash

    python -m sb3_policyflow.export model.zip policy.onnx --vecnormalize vecnormalize.pkl
"""

import argparse
import pickle
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_policyflow.algorithms import ALGORITHMS
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


class ActionModule(nn.Module):
    """Maps observations to actions, as ``predict(deterministic=True)`` does.

    Applies normalization, preprocessing, all steps of the flow or of the denoising chain, and the
    bounds of the actions. Inputs and outputs are tensors, and nothing is drawn at random.

    :param policy: The policy, which is copied.
    :param normalize: The ``VecNormalize`` that the policy was trained with. Without it the module
        takes observations that are normalized already.
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: FlowPolicy, normalize: VecNormalize | None = None) -> None:
        super().__init__()
        self.policy = deepcopy(getattr(policy, "_orig_mod", policy)).cpu()
        self.policy.set_training_mode(False)
        if self.policy.deterministic_action == "drawn":
            self.policy.deterministic_action = "mode"
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
            latents = self.policy.draw_latents(features, deterministic=True)
        actions = self.policy.transport(latents, features).reshape(-1, *self.low.shape)
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
        """Zeros of the dtype that the input has: float32 if it is normalized in the graph."""
        assert space.shape is not None
        dtype = np.float32 if key in self.normalizers else space.dtype
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


def export(
    policy: FlowPolicy,
    path: str | Path,
    normalize: VecNormalize | None = None,
    latents: bool = False,
) -> None:
    """Write a policy to a file that runs without this package.

    An ``.onnx`` file is a graph for onnxruntime and similar programs. Its inputs are "observation",
    or the keys of a Dict space, and with ``latents`` also "latents"; its output is "actions". A
    ``.pt2`` file is a program for ``torch.export.load``. The batch may have any size.

    :param policy: The policy, ``model.policy``.
    :param path: The file, which ends in ".onnx" or ".pt2".
    :param normalize: The ``VecNormalize`` that the policy was trained with. If it is missing, the
        file takes observations that are normalized already, and returns wrong actions for others.
    :param latents: Whether the latents z, shape (n, action_dim), are an input; otherwise they are
        those of the deterministic action.
    :raises ValueError: If ``path`` has another suffix.
    """
    path = Path(path)
    if path.suffix not in (".onnx", ".pt2"):
        raise ValueError(f"The file must end in '.onnx' or '.pt2', got {path.name!r}.")
    module = ActionModule(policy, normalize).eval()
    example = module.example(latents)
    with th.no_grad():
        program = th.export.export(module, example, dynamic_shapes=_any_batch(example))
    if path.suffix == ".pt2":
        th.export.save(program, path)
    else:
        _write_onnx(program, example, path)


def _any_batch(example: tuple[Any, ...]) -> tuple[Any, ...]:
    """Dynamic shapes in which the first axis of every input may have any size."""
    batch = {0: th.export.Dim.DYNAMIC}
    return tuple(
        dict.fromkeys(part, batch) if isinstance(part, dict) else batch for part in example
    )


def _write_onnx(program: th.export.ExportedProgram, example: tuple[Any, ...], path: Path) -> None:
    observations = example[0]
    names = list(observations) if isinstance(observations, dict) else ["observation"]
    th.onnx.export(
        program,
        f=path,
        input_names=[*names, "latents"][: len(names) + len(example) - 1],
        output_names=["actions"],
        dynamo=True,
        external_data=False,
        verbose=False,
    )


def load_policy(path: str | Path) -> FlowPolicy:
    """Load the policy of a saved model, whichever algorithm of this package trained it.

    :param path: The model's zip file.
    :return: The policy, on the CPU.
    :raises ValueError: If no algorithm of this package trained it.
    """
    data, _, _ = load_from_zip_file(path, device="cpu")
    policy_class = (data or {}).get("policy_class", object)
    for algorithm in ALGORITHMS.values():
        if issubclass(policy_class, algorithm.policy_base):
            return algorithm.load(path, device="cpu").policy
    raise ValueError(
        f"{path} holds a {policy_class.__name__}, which is no flow policy: export it as "
        "Stable-Baselines3 documents."
    )


def main(arguments: list[str] | None = None) -> None:
    """Export a policy from the command line.

    :param arguments: Arguments of the command line; those of the process if not given.
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_policyflow.export", description=__doc__)
    parser.add_argument("model", help="the model's zip file")
    parser.add_argument("output", help="the file to write, .onnx or .pt2")
    parser.add_argument("--vecnormalize", metavar="PKL", help="what VecNormalize.save wrote")
    parser.add_argument("--latents", action="store_true", help="make the latents an input")
    options = parser.parse_args(arguments)
    normalize = None
    if options.vecnormalize is not None:
        normalize = pickle.loads(Path(options.vecnormalize).read_bytes())
    export(load_policy(options.model), options.output, normalize, options.latents)
    sys.stdout.write(f"Wrote {options.output}\n")


if __name__ == "__main__":
    main()
