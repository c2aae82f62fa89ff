"""Orders of the solvers, and torchdiffeq as their oracle."""

import math

import pytest
import torch as th
import torchdiffeq

from sb3_policyflow.flows import SOLVERS, VelocityField, integrate
from sb3_policyflow.flows.solvers import solver_times

LATENTS = th.tensor([[0.3, -1.2], [2.0, 0.5]], dtype=th.float64)


def swirl(points: th.Tensor, time: th.Tensor) -> th.Tensor:
    """A smooth field that depends on time and is not linear."""
    x, y = points.unbind(-1)
    return th.stack([th.sin(y) + time * x, th.cos(2 * x) - time**2 * y], dim=-1)


def exact(end_time: float) -> th.Tensor:
    times = th.tensor([0.0, end_time], dtype=th.float64)
    solution: th.Tensor = torchdiffeq.odeint(
        lambda t, x: swirl(x, t), LATENTS, times, method="dopri5", rtol=1e-12, atol=1e-12
    )
    return solution[-1]


@pytest.mark.parametrize("end_time", [1.0, math.pi / 2])
@pytest.mark.parametrize("solver", SOLVERS)
def test_halving_the_step_divides_the_error_by_two_to_the_order(
    solver: str, end_time: float
) -> None:
    reference = exact(end_time)
    coarse, fine = (
        (integrate(swirl, LATENTS, n_steps=n, solver=solver, end_time=end_time) - reference)
        .abs()
        .max()
        for n in (64, 128)
    )
    assert math.log2(coarse / fine) == pytest.approx(SOLVERS[solver].order, abs=0.15)


@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_converge_to_dopri5(solver: str) -> None:
    tolerance = {1: 1e-3, 2: 1e-5, 4: 1e-10}[SOLVERS[solver].order]
    ours = integrate(swirl, LATENTS, n_steps=4_000, solver=solver)
    th.testing.assert_close(ours, exact(1.0), atol=tolerance, rtol=0)


@pytest.mark.parametrize("solver", ["euler", "midpoint"])
def test_same_steps_as_torchdiffeq(solver: str) -> None:
    times = th.linspace(0, 1, 13, dtype=th.float64)
    theirs = torchdiffeq.odeint(lambda t, x: swirl(x, t), LATENTS, times, method=solver)[-1]
    ours = integrate(swirl, LATENTS, n_steps=12, solver=solver)
    th.testing.assert_close(ours, theirs, atol=1e-13, rtol=0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_velocity_is_looked_up_on_the_grid_and_as_often_as_said(solver: str) -> None:
    seen: list[float] = []

    def recording(points: th.Tensor, time: th.Tensor) -> th.Tensor:
        seen.append(time.item())
        return points

    integrate(recording, LATENTS, n_steps=5, solver=solver)
    grid = solver_times(solver, 5).tolist()
    assert len(seen) == 5 * SOLVERS[solver].n_stages
    assert set(seen) <= set(grid)
    assert grid[0] == 0.0
    assert grid[-1] == 1.0


def test_two_midpoint_steps_by_hand() -> None:
    """dx/dt = x from 1 with h = 1/2: each step multiplies by 1 + h + h^2/2 = 1.625."""
    one = th.ones(1, 1, dtype=th.float64)
    assert integrate(lambda x, _: x, one, n_steps=2).item() == 1.625**2


def test_flow_of_a_network_against_dopri5() -> None:
    field = VelocityField(2, 3, net_arch=[16, 16], initialization="glorot").double()
    features = th.randn(2, 3, dtype=th.float64)

    def velocity(x: th.Tensor, t: th.Tensor) -> th.Tensor:
        return field(x, t, features)  # type: ignore[no-any-return]

    times = th.tensor([0.0, 1.0], dtype=th.float64)
    reference = torchdiffeq.odeint(lambda t, x: velocity(x, t), LATENTS, times, method="dopri5")
    ours = integrate(velocity, LATENTS, n_steps=200, solver="rk4")
    th.testing.assert_close(ours, reference[-1], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("n_steps", [0, -3])
def test_no_steps_are_refused(n_steps: int) -> None:
    with pytest.raises(ValueError, match="at least one solver step"):
        integrate(swirl, LATENTS, n_steps=n_steps)


def test_unknown_solver_is_refused_with_the_choices() -> None:
    with pytest.raises(
        ValueError,
        match=r"solver must be one of 'euler', 'midpoint', 'heun', 'rk4', 'ab2', got 'newton'",
    ):
        integrate(swirl, LATENTS, solver="newton")
