"""Kernels yield what plain torch yields, up to rounding in float32."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_policyflow.flows import SOLVERS
from sb3_policyflow.kernels.activations import Activation
from sb3_policyflow.kernels.inspection import ModuleInspector
from tests.helpers import learned
from tests.kernels.plain import (
    ACTIVATIONS,
    SHAPES,
    Critic,
    integrate_plainly,
    make_field,
    plain_copy,
)


def close(ours: th.Tensor, theirs: th.Tensor, ulps: float = 60) -> None:
    """Equal up to some roundings of the largest number."""
    scale = theirs.detach().abs().max().clamp(min=1e-3).item()
    th.testing.assert_close(ours, theirs, rtol=0, atol=ulps * scale * 2**-24)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_activations_and_derivatives(activation: Any) -> None:
    """Against torch in float64; a network of one unit is its activation."""
    module = activation()
    x = th.cat([th.linspace(-100, 100, 2001), th.linspace(-1, 1, 2001)]).view(-1, 1)
    inputs = x.clone().requires_grad_()
    ours = identity(module)(inputs)
    ours.sum().backward()
    exact = x.double().requires_grad_()
    theirs = module(exact)
    theirs.sum().backward()
    th.testing.assert_close(ours.double(), theirs, rtol=1e-6, atol=1e-7)
    assert inputs.grad is not None
    assert exact.grad is not None
    th.testing.assert_close(inputs.grad.double(), exact.grad, rtol=2e-6, atol=5e-7)


def identity(module: nn.Module) -> Critic:
    """A network of one unit that is its activation."""
    layers = nn.Linear(1, 1), module, nn.Linear(1, 1)
    for layer in (layers[0], layers[2]):
        nn.init.ones_(layer.weight)
        nn.init.zeros_(layer.bias)
    return Critic(*layers)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_not_a_number_stays_one(activation: Any) -> None:
    inputs = th.tensor([[1.0], [math.nan], [-1.0]])
    outputs = identity(activation())(inputs)
    assert outputs.isnan().flatten().tolist() == [False, True, False]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("end_time", [1.0, math.pi / 2])
def test_flow_by_solver_activation_and_path(solver: str, activation: Any, end_time: float) -> None:
    field = make_field(3, 5, [24, 40], activation)
    z, s = th.randn(37, 3), th.randn(37, 5)
    options: dict[str, Any] = {"solver": solver, "n_steps": 7, "end_time": end_time}
    with th.no_grad():
        ours = field.integrate(z, s, **options)
        close(ours, integrate_plainly(field, z, s, **options))


@pytest.mark.parametrize(("dim", "features_dim", "widths"), SHAPES)
@pytest.mark.parametrize("n_rows", [1, 2, 16, 17, 100])
def test_flow_by_size(dim: int, features_dim: int, widths: list[int], n_rows: int) -> None:
    field = make_field(dim, features_dim, widths, nn.Mish)
    z, s = th.randn(n_rows, dim), th.randn(n_rows, features_dim)
    options: dict[str, Any] = {"solver": "midpoint", "n_steps": 12, "end_time": 1.0}
    with th.no_grad():
        ours = field.integrate(z, s, **options)
        close(ours, integrate_plainly(field, z, s, **options))


@pytest.mark.parametrize(("dim", "features_dim", "widths"), SHAPES)
@pytest.mark.parametrize("n_rows", [1, 17])
@pytest.mark.parametrize("n_candidates", [2, 16, 100])
def test_choice_of_a_latent(
    dim: int, features_dim: int, widths: list[int], n_rows: int, n_candidates: int
) -> None:
    """Against the formula in float64."""
    field = make_field(dim, features_dim, widths, nn.Mish)
    candidates, s = th.randn(n_candidates, dim), 3 * th.randn(n_rows, features_dim)
    options: dict[str, Any] = {"solver": "midpoint", "n_steps": 4}
    with th.no_grad():
        latents, ends = field.choose_latents(candidates, s, **options)
    plain, expected = plain_copy(field).double(), []
    for latent, features in zip(latents, s, strict=True):
        same = features.double().expand(n_candidates, -1)
        points = integrate_plainly(plain, candidates.double(), same, **options)
        squared_bandwidth = 0.25 * n_candidates ** (-2 / (dim + 4)) * points.var(0, correction=0)
        distances = th.cdist(points, points).square()
        densities = (-distances / (2 * squared_bandwidth.sum())).exp().sum(0)
        densities[0] *= 1.5
        best = densities.argmax()
        assert th.equal(latent, candidates[best])
        expected.append(points[best].float())
    th.testing.assert_close(ends, th.stack(expected), rtol=1e-5, atol=1e-6)


def test_choice_of_a_latent_for_nobody_and_among_one() -> None:
    field = make_field(2, 3, [8])
    options: dict[str, Any] = {"solver": "euler", "n_steps": 2}
    with th.no_grad():
        nobody = field.choose_latents(th.randn(4, 2), th.zeros(0, 3), **options)
        latents, _ = field.choose_latents(th.ones(1, 2), th.zeros(5, 3), **options)
    assert [part.shape for part in nobody] == [(0, 2), (0, 2)]
    assert th.equal(latents, th.ones(5, 2))


def test_an_action_does_not_depend_on_who_else_acts() -> None:
    """To the last bit, whatever the batch and the number of threads."""
    field = make_field(2, 4, [256, 128, 64], nn.Mish)
    options: dict[str, Any] = {"solver": "midpoint", "n_steps": 12}
    z, s = th.randn(601, 2), th.randn(601, 4)
    with th.no_grad():
        together = field.integrate(z, s, **options)
        th.set_num_threads(3)
        try:
            assert th.equal(field.integrate(z, s, **options), together)
        finally:
            th.set_num_threads(1)
        for row in (0, 13, 600):
            alone = field.integrate(z[row : row + 1], s[row : row + 1], **options)
            assert th.equal(alone[0], together[row])


@pytest.mark.parametrize("embedding_dim", [1, 8, 512])
@pytest.mark.parametrize("scale", [1.0, 16.0])
def test_flow_by_embedding(embedding_dim: int, scale: float) -> None:
    field = make_field(2, 4, [32, 32], embedding_dim=embedding_dim, frequency_scale=scale)
    z, s = th.randn(20, 2), th.randn(20, 4)
    options: dict[str, Any] = {"solver": "midpoint", "n_steps": 12, "end_time": 1.0}
    with th.no_grad():
        ours = field.integrate(z, s, **options)
        close(ours, integrate_plainly(field, z, s, **options))


def gradients(field: nn.Module, inputs: list[th.Tensor], weights: th.Tensor) -> list[th.Tensor]:
    """Velocity, and gradients of parameters, points and features."""
    points, times, features = (
        tensor.clone().requires_grad_(needs)
        for tensor, needs in zip(inputs, (True, False, True), strict=True)
    )
    velocity = field(points, times, features)
    leaves = [*learned(field), points, features]
    return [velocity, *th.autograd.grad((velocity * weights).sum(), leaves)]


GRID = th.linspace(0, 1, 25)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(("dim", "features_dim", "widths"), SHAPES)
def test_velocity_and_gradients(
    activation: Any, dim: int, features_dim: int, widths: list[int]
) -> None:
    field = make_field(dim, features_dim, widths, activation)
    inputs = [th.randn(53, dim), GRID[th.randint(25, (53,))], th.randn(53, features_dim)]
    compare_gradients(field, inputs)


def compare_gradients(field: nn.Module, inputs: list[th.Tensor]) -> None:
    weights = th.randn_like(inputs[0])
    theirs = gradients(plain_copy(field), inputs, weights)  # type: ignore[arg-type]
    for ours, expected in zip(gradients(field, inputs, weights), theirs, strict=True):
        close(ours, expected, ulps=400)


@pytest.mark.parametrize(
    ("points", "times", "features"),
    [
        ((40, 3, 2), (40, 3), (40, 1, 5)),
        ((40, 3, 2), (40, 3), (40, 3, 5)),
        ((40, 3, 2), (3,), (40, 1, 5)),
        ((40, 3, 2), (), (40, 1, 5)),
        ((40, 3, 2), (40, 1), (5,)),
        ((40, 2), (), (40, 5)),
        ((1, 2), (1,), (1, 5)),
        ((4, 3, 5, 2), (4, 1, 5), (4, 3, 1, 5)),
    ],
)
def test_shapes_that_broadcast(points: Any, times: Any, features: Any) -> None:
    field = make_field(2, 5, [16, 16])
    compare_gradients(field, [th.randn(points), th.rand(times), th.randn(features)])


def test_gradients_on_several_threads() -> None:
    field = make_field(2, 4, [128, 64], nn.Mish)
    inputs = [th.randn(1501, 2, 2), th.rand(1501, 2), th.randn(1501, 1, 4)]
    th.set_num_threads(4)
    try:
        compare_gradients(field, inputs)
    finally:
        th.set_num_threads(1)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_critic_and_gradients(activation: Any) -> None:
    critic = Critic(
        nn.Linear(11, 32), activation(), nn.Linear(32, 20), activation(), nn.Linear(20, 1)
    )
    network = critic.plain
    x = th.randn(70, 11)
    ours_x, theirs_x = x.clone().requires_grad_(), x.clone().requires_grad_()
    ours, theirs = critic(ours_x), network(theirs_x)
    close(ours, theirs)
    found = th.autograd.grad(ours.square().sum(), [ours_x, *network.parameters()])
    expected = th.autograd.grad(theirs.square().sum(), [theirs_x, *network.parameters()])
    for gradient, other in zip(found, expected, strict=True):
        close(gradient, other, ulps=400)


@pytest.mark.parametrize("shape", [(4,), (4, 3)])
def test_derivatives_of_derivatives(shape: Any) -> None:
    field = make_field(2, 3, [8, 8])
    t, s = th.rand(shape), th.randn(4, 3) if len(shape) == 1 else th.randn(4, 1, 3)
    second = []
    for net in (field, plain_copy(field)):
        x = th.linspace(-1, 1, 2 * t.numel()).view(*shape, 2).requires_grad_()
        (slope,) = th.autograd.grad(net(x, t, s).sum(), x, create_graph=True)
        second.append(th.autograd.grad(slope.square().sum(), [x, net.hidden[0].weight]))
    for ours, theirs in zip(*second, strict=True):
        close(ours, theirs, ulps=400)


def test_derivatives_of_derivatives_of_a_critic() -> None:
    critic = Critic(nn.Linear(3, 8), nn.Mish(), nn.Linear(8, 1))
    second = []
    for function in (critic, critic.plain):
        x = th.linspace(-1, 1, 12).view(4, 3).requires_grad_()
        (slope,) = th.autograd.grad(function(x).sum(), x, create_graph=True)
        second.append(th.autograd.grad(slope.square().sum(), [x, *critic.plain[:2:2].parameters()]))
    for ours, theirs in zip(*second, strict=True):
        close(ours, theirs, ulps=400)


def test_derivatives_of_derivatives_are_those_of_the_weights_then() -> None:
    """Even if the parameters have been replaced before the backward pass."""
    field = make_field(2, 3, [8])
    plain = plain_copy(field)
    x, t, s = th.randn(4, 2), th.rand(4), th.randn(4, 3)
    second = []
    for net in (field, plain):
        points = x.clone().requires_grad_()
        velocity = net(points, t, s)
        net.hidden[0] = nn.Linear(66, 8)
        (slope,) = th.autograd.grad(velocity.square().sum(), points, create_graph=True)
        second.append(th.autograd.grad(slope.square().sum(), points)[0])
    close(*second, ulps=400)


def test_weights_changed_between_the_two_ways_are_noticed() -> None:
    field = make_field(2, 3, [8])
    velocity = field(th.randn(4, 2), th.rand(4), th.randn(4, 3))
    with th.no_grad():
        field.output.weight.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        velocity.sum().backward()


def test_numbers_of_activations_are_names_of_nothing_else() -> None:
    kinds = [ModuleInspector().activation(activation()) for activation in ACTIVATIONS]
    assert all(isinstance(kind, Activation) for kind in kinds)
    assert len(set(kinds)) == len(ACTIVATIONS)
    assert np.unique([kind.kind for kind in kinds if kind]).tolist() == list(range(12))
