"""What kernels do not serve goes the plain way, and says so to those who debug."""

import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.flows import integrate
from sb3_policyflow.kernels.compiler import note_fallback
from sb3_policyflow.kernels.fields import KernelVelocityField
from tests.helpers import learned
from tests.kernels.plain import integrate_plainly, make_field, plain_copy

OPTIONS: dict[str, Any] = {"solver": "midpoint", "n_steps": 4, "end_time": 1.0}


@pytest.mark.parametrize("activation", [nn.SELU, nn.Softsign, nn.ReLU6])
def test_other_activations(activation: Any, caplog: pytest.LogCaptureFixture) -> None:
    note_fallback.cache_clear()
    field = make_field(2, 3, [8, 8], activation)
    z, s = th.randn(6, 2), th.randn(6, 3)
    with caplog.at_level(logging.DEBUG, "sb3_policyflow"), th.no_grad():
        ours = field.integrate(z, s, **OPTIONS)
    th.testing.assert_close(ours, integrate_plainly(field, z, s, **OPTIONS))
    assert "Plain torch does the work of a kernel" in caplog.text
    assert all(record.levelno == logging.DEBUG for record in caplog.records)


@pytest.mark.parametrize("widths", [[], [8]])
@pytest.mark.parametrize("dtype", [th.float64, th.bfloat16])
def test_other_types_and_no_hidden_layers(widths: list[int], dtype: th.dtype) -> None:
    field = make_field(2, 3, widths).to(dtype)
    z, s = th.randn(6, 2, dtype=dtype), th.randn(6, 3, dtype=dtype)
    ours = field.integrate(z, s, **OPTIONS)
    assert ours.dtype == dtype
    tolerance = 1e-12 if dtype == th.float64 else 5e-2
    expected = integrate_plainly(field, z, s, **OPTIONS)
    th.testing.assert_close(ours, expected, rtol=tolerance, atol=tolerance)


def test_gradients_through_the_flow() -> None:
    field = make_field(2, 3, [8, 8])
    plain = plain_copy(field)
    z, s = th.randn(6, 2), th.randn(6, 3)
    ours = field.integrate(z, s, **OPTIONS).square().sum()
    theirs = integrate(lambda x, t: plain(x, t, s), z, **OPTIONS).square().sum()
    for gradient, expected in zip(
        th.autograd.grad(ours, learned(field)),
        th.autograd.grad(theirs, learned(plain)),
        strict=True,
    ):
        th.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-5)


def test_transformations_of_functions() -> None:
    field = make_field(2, 3, [8, 8])
    plain = plain_copy(field)
    x, t, s = th.randn(6, 2), th.rand(6), th.randn(6, 3)
    ours = th.func.vmap(field)(x, t, s)
    th.testing.assert_close(ours, plain(x, t, s))
    slopes = [th.func.vmap(th.func.jacrev(net))(x, t, s) for net in (field, plain)]
    th.testing.assert_close(*slopes)


def test_gradients_of_times() -> None:
    field = make_field(2, 3, [8, 8])
    x, s = th.randn(6, 2), th.randn(6, 3)
    grads = []
    for net in (field, plain_copy(field)):
        t = th.linspace(0, 1, 6, requires_grad=True)
        grads.append(th.autograd.grad(net(x, t, s).sum(), t)[0])
    th.testing.assert_close(*grads)


def test_autocast_keeps_its_type() -> None:
    field = make_field(2, 3, [8, 8])
    x, t, s = th.randn(6, 2), th.rand(6), th.randn(6, 3)
    with th.autocast("cpu", th.bfloat16):
        assert field(x, t, s).dtype == plain_copy(field)(x, t, s).dtype == th.bfloat16


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_traced_and_exported_fields_contain_their_weights() -> None:
    field = make_field(2, 3, [8, 8])
    inputs = th.randn(6, 2), th.rand(6), th.randn(6, 3)
    others = th.randn(6, 2), th.rand(6), th.randn(6, 3)
    traced = th.jit.trace(field, inputs)
    exported = th.export.export(field, inputs).module()
    with th.no_grad():
        th.testing.assert_close(traced(*others), field(*others))
        th.testing.assert_close(exported(*others), field(*others))


def test_a_subclass_has_its_own_velocity() -> None:
    class Still(KernelVelocityField):
        def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
            return th.zeros_like(points)

    z = th.randn(4, 2)
    with th.no_grad():
        assert th.equal(Still(2, 3, [8]).integrate(z, th.randn(4, 3), **OPTIONS), z)


@pytest.mark.parametrize("n_rows", [0, 3])
def test_wrong_sizes_raise_torchs_errors_and_none_is_fine(n_rows: int) -> None:
    field = make_field(2, 3, [8])
    good = field(th.randn(n_rows, 2), th.rand(n_rows), th.randn(n_rows, 3))
    good.sum().backward()
    assert good.shape == (n_rows, 2)
    with pytest.raises(RuntimeError):
        field(th.randn(4, 2), th.rand(4), th.randn(4, 7))
    with pytest.raises(RuntimeError):
        field(th.randn(4, 5), th.rand(4), th.randn(4, 3))


TRAIN = """
import sys, logging
logging.basicConfig(level=logging.DEBUG)
from sb3_policyflow import PolicyFlow
assert "numba" not in sys.modules, "imported with the package"
{setup}
model = PolicyFlow("MlpFlowPolicy", "Pendulum-v1", n_steps=32, batch_size=16, n_epochs=2, seed=0)
model.learn(64)
print(float(model.policy.parameters_to_vector().sum()))
print("loaded", "sb3_policyflow.kernels._numba.mlp" in sys.modules)
"""


def train_in_a_process(setup: str = "", **environment: str) -> tuple[list[str], str]:
    done = subprocess.run(
        [sys.executable, "-c", TRAIN.format(setup=setup)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )
    return done.stdout.split("\n"), done.stderr


NO_FOLDER = """
from numba.core import caching
caching.CacheImpl._locator_classes = []
"""


@pytest.mark.slow
@pytest.mark.parametrize("setup", ["sys.modules['numba'] = None", NO_FOLDER])
def test_without_numba_everything_works_and_is_the_same(setup: str) -> None:
    """It is not there, or has no folder to keep in what it compiles."""
    (with_it, loaded, *_), _ = train_in_a_process()
    (without, missing, *_), messages = train_in_a_process(setup)
    assert (loaded, missing) == ("loaded True", "loaded False")
    assert float(without) == pytest.approx(float(with_it), abs=1e-3)
    assert "numba cannot be used" in messages


@pytest.mark.slow
def test_kernels_are_kept_for_the_next_process(tmp_path: Path) -> None:
    def compiled() -> dict[Path, int]:
        train_in_a_process(NUMBA_CACHE_DIR=str(tmp_path))
        return {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb?")}

    first = compiled()
    assert len({path.name.split(".")[1].split("-")[0] for path in first}) >= 6
    assert compiled() == first


@pytest.mark.parametrize("algorithm", [PolicyFlow, FPO, DPPO])
def test_nothing_falls_back_in_a_training(
    algorithm: type[FlowOnPolicyAlgorithm], caplog: pytest.LogCaptureFixture
) -> None:
    """Not even where an update looks at parts of tensors, as DPPO's does at those of its chains."""
    note_fallback.cache_clear()
    model = algorithm("MlpPolicy", "Pendulum-v1", n_steps=32, batch_size=16, n_epochs=1)
    with caplog.at_level(logging.DEBUG, "sb3_policyflow"):
        model.learn(32)
    assert "Plain torch" not in caplog.text
