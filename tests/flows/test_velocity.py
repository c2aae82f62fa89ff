import math
from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_policyflow.flows import SOLVERS, FourierTimeEmbedding, VelocityField, integrate
from sb3_policyflow.flows.folding import is_foldable
from tests.helpers import learned


def test_time_embedding_sees_cosines_and_sines_of_its_frequencies() -> None:
    embedding = FourierTimeEmbedding(4, frequencies=[1.0, 2.0])
    embedding.mlp = nn.Identity()
    time = th.tensor(0.125)
    expected = th.tensor([math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 1.0])
    th.testing.assert_close(embedding(time), expected, atol=1e-6, rtol=0)


def test_frequencies_are_fixed_but_saved() -> None:
    embedding = FourierTimeEmbedding(8, frequencies=3, frequency_scale=16.0)
    assert "frequencies" in embedding.state_dict()
    embedding.requires_grad_(True)
    embedding(th.rand(5)).sum().backward()
    assert embedding.frequencies.grad is None
    assert embedding.frequencies.shape == (3,)
    assert len(FourierTimeEmbedding(8).frequencies) == 4  # the paper's d / 2


def test_field_is_the_formula_of_the_paper() -> None:
    field = VelocityField(2, 3, net_arch=[5], activation_fn=nn.SiLU, initialization="glorot")
    x, t, s = th.randn(7, 2), th.rand(7), th.randn(7, 3)
    embedding = field.time_embedding(t) + field.observation_embedding(s)
    first, last = field.hidden[0], field.output
    assert isinstance(first, nn.Linear)
    hidden = nn.functional.silu(th.cat([x, embedding], -1) @ first.weight.T + first.bias)
    th.testing.assert_close(field(x, t, s), hidden @ last.weight.T + last.bias)


def test_leading_shapes_broadcast() -> None:
    field = VelocityField(2, 3, initialization="glorot")
    x, t, s = th.randn(6, 4, 2), th.rand(6, 4), th.randn(6, 1, 3)
    together = field(x, t, s)
    one_by_one = th.stack([field(x[:, k], t[:, k], s[:, 0]) for k in range(4)], dim=1)
    th.testing.assert_close(together, one_by_one)
    th.testing.assert_close(
        field(x[:, 0], th.tensor(0.5), s[:, 0])[0], field(x[0, 0], th.tensor(0.5), s[0, 0])
    )


def test_initializations() -> None:
    x, t, s = th.randn(7, 2), th.rand(7), th.randn(7, 3)
    fields = {
        name: VelocityField(2, 3, initialization=name)
        for name in ("glorot", "glorot_zero_output", "zero")
    }
    assert fields["glorot"](x, t, s).abs().min() > 0
    assert th.equal(fields["glorot_zero_output"](x, t, s), th.zeros(7, 2))
    assert fields["glorot_zero_output"].hidden[0].weight.abs().sum() > 0  # type: ignore[operator, union-attr]
    assert all(not parameter.any() for parameter in learned(fields["zero"]))
    wide = VelocityField(200, 3, net_arch=[300], initialization="glorot", embedding_dim=100)
    weight = wide.hidden[0].weight
    assert isinstance(weight, th.Tensor)
    assert weight.std().item() == pytest.approx(math.sqrt(2 / (300 + 300)), rel=0.05)


def test_unknown_initialization_is_refused_with_the_choices() -> None:
    with pytest.raises(ValueError, match=r"'glorot', 'glorot_zero_output', 'zero', got 'ones'"):
        VelocityField(2, 3, initialization="ones")


def test_empty_embedding_is_refused() -> None:
    with pytest.raises(ValueError, match="embedding_dim must be at least 1"):
        VelocityField(2, 3, embedding_dim=0)


OPTIONS: dict[str, Any] = {"n_steps": 3, "end_time": 1.5}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("net_arch", [[], [16, 8]])
def test_splitting_the_first_layer_changes_no_flow_and_no_gradient(
    solver: str, net_arch: list[int]
) -> None:
    field = VelocityField(2, 3, net_arch, initialization="glorot").double()
    z = th.randn(5, 2, dtype=th.float64, requires_grad=True)
    s = th.randn(5, 3, dtype=th.float64, requires_grad=True)
    found = []
    for endpoints in (
        field.integrate(z, s, solver=solver, **OPTIONS),
        integrate(lambda x, t: field(x, t, s), z, solver=solver, **OPTIONS),
    ):
        grads = th.autograd.grad(endpoints.square().sum(), [z, s, *learned(field)])
        found.append([endpoints, *grads])
    assert is_foldable(field)
    th.testing.assert_close(*found)


def test_what_takes_part_in_a_field_takes_part_in_its_flow() -> None:
    field, z, s = VelocityField(2, 3, [8]), th.randn(5, 2), th.randn(5, 3)
    for module in (field, field.hidden[0], field.observation_embedding):
        seen: list[nn.Module] = []
        handle = module.register_forward_hook(lambda module, *_, seen=seen: seen.append(module))  # type: ignore[misc]
        assert not is_foldable(field)
        field.integrate(z, s, solver="heun", **OPTIONS)
        assert seen == 6 * [module]
        handle.remove()
    assert is_foldable(field)


def test_a_subclass_is_integrated_as_its_own_forward_says() -> None:
    class Doubling(VelocityField):
        def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
            return points

    z = th.randn(5, 2)
    end = Doubling(2, 3).integrate(z, th.randn(5, 3), solver="euler", n_steps=2, end_time=2.0)
    assert th.equal(end, 4 * z)


def test_a_flow_of_unknown_solver_or_no_steps_is_refused() -> None:
    field, z, s = VelocityField(2, 3, [8]), th.randn(5, 2), th.randn(5, 3)
    with pytest.raises(ValueError, match="'newton'"):
        field.integrate(z, s, solver="newton", n_steps=3)
    with pytest.raises(ValueError, match="at least one solver step"):
        field.integrate(z, s, solver="euler", n_steps=0)
