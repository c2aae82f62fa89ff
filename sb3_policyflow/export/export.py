"""Writes the files of policies."""

import importlib.util
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.algorithms import ALGORITHMS
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.export.modules import ActionModule
from sb3_policyflow.hints import install_command
from sb3_policyflow.resilience.normalization import check_normalization

OR_NORMALIZED_INPUT = (
    ", or say that the observations will be normalized already (normalized_input=True, "
    "--normalized-input)"
)


def export(
    policy: FlowPolicy | FlowOnPolicyAlgorithm,
    path: str | Path,
    normalize: VecNormalize | None = None,
    latents: bool = False,
    normalized_input: bool = False,
) -> None:
    """Write a policy to a file that runs without this package.

    An ``.onnx`` file is a graph for onnxruntime and similar programs. Its inputs are "observation",
    or the keys of a Dict space, and with ``latents`` also "latents"; its output is "actions". A
    ``.pt2`` file is a program for ``torch.export.load``. The batch may have any size. Observations
    have the dtype of the environment.

    :param policy: The model, which knows whether its observations were normalized, or its policy.
    :param path: The file, which ends in ".onnx" or ".pt2".
    :param normalize: The ``VecNormalize`` that the policy was trained with; by default that of the
        model's environment.
    :param latents: Whether the latents z, shape (n, action_dim), are an input; otherwise they are
        those of the deterministic action.
    :param normalized_input: Whether the file takes observations that are normalized already.
    :raises ValueError: If ``path`` has another suffix, or ``normalize`` is not what a model was
        trained with: it is missing, or the model's observations were not normalized.
    :raises ModuleNotFoundError: If a package is missing that writes ".onnx" files.
    """
    path = Path(path)
    if path.suffix not in (".onnx", ".pt2"):
        raise ValueError(f"The file must end in '.onnx' or '.pt2', got {path.name!r}.")
    if path.suffix == ".onnx":
        _require_onnx()
    space = None
    if isinstance(policy, FlowOnPolicyAlgorithm):
        model, policy = policy, policy.policy
        observed = model.observed()
        space = None if observed is None else observed.space
        normalize = normalize or model.get_vec_normalize_env()
        if not normalized_input:
            check_normalization(model, normalize, "normalize", OR_NORMALIZED_INPUT)
    module = ActionModule(policy, None if normalized_input else normalize, space).eval()
    example = module.example(latents)
    with th.no_grad(), _quiet():
        program = th.export.export(module, example, dynamic_shapes=_any_batch(example))
        _forget_source(program)
        if path.suffix == ".pt2":
            th.export.save(program, path)
        else:
            _write_onnx(program, example, path)


def _forget_source(program: th.export.ExportedProgram) -> None:
    """Remove PyTorch's notes of where operators came from, with folders of this machine."""
    for module in program.graph_module.modules():
        if isinstance(module, th.fx.GraphModule):
            for node in module.graph.nodes:
                node.meta.pop("stack_trace", None)


def _require_onnx() -> None:
    missing = [name for name in ("onnx", "onnxscript") if not _is_installed(name)]
    if missing:
        raise ModuleNotFoundError(
            f"Export to ONNX needs {' and '.join(missing)}: run `{install_command('onnx')}`.",
            name=missing[0],
        )


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # what has been imported as None
        return False


@contextmanager
def _quiet() -> Iterator[None]:
    """Without PyTorch's remarks on operators that no policy has, and on its own deprecations."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning, module="torch|copyreg")
            yield
    finally:
        logger.setLevel(level)


def _any_batch(example: tuple[Any, ...]) -> tuple[Any, ...]:
    """Dynamic shapes in which the first axis of every input may have any size."""
    batch = {0: th.export.Dim.DYNAMIC}
    return tuple(
        dict.fromkeys(part, batch) if isinstance(part, dict) else batch for part in example
    )


def _write_onnx(program: th.export.ExportedProgram, example: tuple[Any, ...], path: Path) -> None:
    observations = example[0]
    names = list(observations) if isinstance(observations, dict) else ["observation"]
    onnx_program = th.onnx.export(
        program,
        input_names=[*names, "latents"][: len(names) + len(example) - 1],
        output_names=["actions"],
        dynamo=True,
        verbose=False,
    )
    assert onnx_program is not None
    axes = [part.shape[0] for part in onnx_program.model.graph.inputs if part.shape]
    onnx_program.rename_axes({str(axis): "batch" for axis in axes})
    onnx_program.save(path, external_data=False)


def load_model(path: str | Path) -> FlowOnPolicyAlgorithm:
    """Load a saved model, whichever algorithm of this package trained it.

    :param path: The model's zip file.
    :return: The model, on the CPU and without an environment.
    :raises ValueError: If no algorithm of this package trained it.
    """
    data, _, _ = load_from_zip_file(path, device="cpu")
    policy_class = (data or {}).get("policy_class", object)
    for algorithm in ALGORITHMS.values():
        if issubclass(policy_class, algorithm.policy_base):
            return algorithm.load(path, device="cpu")
    raise ValueError(
        f"{path} holds a {policy_class.__name__}, which is no flow policy: export it as "
        "Stable-Baselines3 documents."
    )


def load_policy(path: str | Path) -> FlowPolicy:
    """Load the policy of a saved model, whichever algorithm of this package trained it.

    :param path: The model's zip file.
    :return: The policy, on the CPU.
    :raises ValueError: If no algorithm of this package trained it.
    """
    return load_model(path).policy
