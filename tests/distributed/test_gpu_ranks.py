"""Ranks on a GPU: nccl with one rank, and two ranks on one GPU, which gloo connects."""

from typing import Any

import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from torch import distributed as dist

from sb3_policyflow.distributed.group import process_group
from tests.distributed.launch import run_ranks
from tests.distributed.workers import model_of
from tests.helpers import weights

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU"),
]


def operations() -> dict[str, Any]:
    """What each operation of the ranks returns for tensors on the GPU."""
    group = process_group()
    device = th.device("cuda")
    group.connect(device)
    parameter = th.nn.Parameter(th.zeros(3, 2, device=device))
    parameter.grad = th.ones(3, 2, device=device)
    loss = group.average_gradients([parameter], 2.0)
    mean, std = group.mean_std(th.tensor([1.0, 2.0, 3.0], device=device))
    return {
        "backend": dist.get_backend(),
        "numbers": [loss, mean.item(), std.item(), parameter.grad.sum().item()],
        "metrics": group.average_metrics({"loss": 1.0, "log_ratio_max": 2.0}),
        "objects": [group.gather("a"), group.from_first("b"), group.gather_on_first("c")],
    }


def train_on_one_gpu() -> tuple[str, th.Tensor]:
    """Three updates with the model on the GPU that the other rank has too."""
    dist.init_process_group("gloo")
    model = model_of(make_vec_env("Pendulum-v1", 2), device="cuda:0", desired_kl=0.01)
    model.learn(3 * 16 * 4)
    return str(model.device), weights(model).cpu()


def test_nccl_knows_every_operation() -> None:
    (result,) = run_ranks(1, operations)
    assert result == {
        "backend": "nccl",
        "numbers": [2.0, 2.0, 1.0, 6.0],
        "metrics": {"loss": 1.0, "log_ratio_max": 2.0},
        "objects": [["a"], "b", ["c"]],
    }


def test_two_ranks_on_one_gpu_learn_the_same() -> None:
    (device, first), (_, second) = run_ranks(2, train_on_one_gpu)
    assert device == "cuda:0"
    assert th.equal(first, second)
    assert th.isfinite(first).all()
