"""Laws of the interpolants, in float64."""

import math

import pytest
import torch as th

from sb3_policyflow.flows import INTERPOLANTS, Interpolant, StochasticInterpolant

EXACT = ["rectified", "stochastic_exact", "trigflow"]


def interior_times(interpolant: Interpolant, n: int = 9) -> th.Tensor:
    return interpolant.end_time * th.linspace(0.1, 0.9, n, dtype=th.float64)


def points(n: int = 9, dim: int = 3) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    latents, endpoints, noise = th.randn(3, n, dim, dtype=th.float64)
    return latents, endpoints, noise


@pytest.mark.parametrize("name", INTERPOLANTS)
def test_path_starts_at_the_latent_and_ends_at_the_endpoint(name: str) -> None:
    interpolant = INTERPOLANTS[name]()
    latents, endpoints, noise = points()
    start, end = (
        th.zeros(9, dtype=th.float64),
        th.full((9,), interpolant.end_time, dtype=th.float64),
    )
    th.testing.assert_close(interpolant.interpolate(latents, endpoints, start, noise), latents)
    th.testing.assert_close(interpolant.interpolate(latents, endpoints, end, noise), endpoints)


@pytest.mark.parametrize("name", INTERPOLANTS)
def test_derivative_equals_autograd(name: str) -> None:
    interpolant = INTERPOLANTS[name]()
    latents, endpoints, noise = points()
    times = interior_times(interpolant).requires_grad_()
    interpolated = interpolant.interpolate(latents, endpoints, times, noise)
    for dim in range(3):
        (slope,) = th.autograd.grad(interpolated[:, dim].sum(), times, retain_graph=True)
        derivative = interpolant.derivative(latents, endpoints, times, noise)[:, dim]
        th.testing.assert_close(derivative, slope)


def test_deterministic_paths_ignore_noise_and_the_stochastic_one_draws_its_own() -> None:
    latents, endpoints, noise = points()
    for name in ("rectified", "trigflow"):
        interpolant = INTERPOLANTS[name]()
        times = interior_times(interpolant)
        with_noise = interpolant.interpolate(latents, endpoints, times, noise)
        assert th.equal(with_noise, interpolant.interpolate(latents, endpoints, times))
    interpolant = StochasticInterpolant()
    times = interior_times(interpolant)
    first, second = (interpolant.interpolate(latents, endpoints, times) for _ in range(2))
    assert not th.equal(first, second)


def test_stochastic_path_has_the_spread_of_the_table() -> None:
    n = 200_000
    zeros, times = th.zeros(n, 1, dtype=th.float64), th.full((n,), 0.3, dtype=th.float64)
    spread = StochasticInterpolant().interpolate(zeros, zeros, times).std().item()
    assert spread == pytest.approx(math.sqrt(2 * 0.3 * 0.7), rel=0.01)


def gaussian_velocity_and_score(
    interpolant: Interpolant,
    times: th.Tensor,
    x: th.Tensor,
    mean: float,
    std: float,
    latent_std: float = 1.0,
) -> tuple[th.Tensor, th.Tensor]:
    """Velocity and score of x_t when z ~ N(0, latent_std^2), phi ~ N(mean, std^2) are independent.

    x_t and dx_t/dt are jointly Gaussian: v(x) = E[dx_t/dt | x_t = x] is linear regression.
    """
    a, b, c = (k.unsqueeze(-1) for k in interpolant.coefficients(times))
    da, db, dc = (k.unsqueeze(-1) for k in interpolant.derivative_coefficients(times))
    variance = (a * latent_std) ** 2 + (b * std) ** 2 + c**2
    covariance = da * a * latent_std**2 + db * b * std**2 + dc * c
    deviation = x - b * mean
    return db * mean + covariance / variance * deviation, -deviation / variance


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("std", [0.2, 1.0, 3.0])
def test_score_velocity_relation_is_exact(name: str, std: float) -> None:
    interpolant = INTERPOLANTS[name]()
    times, x = interior_times(interpolant), th.randn(9, 2, dtype=th.float64)
    velocity, score = gaussian_velocity_and_score(interpolant, times, x, mean=0.7, std=std)
    c, a, b = (k.unsqueeze(-1) for k in interpolant.score_coefficients(times))
    th.testing.assert_close(c * score, a * velocity - b * x)


@pytest.mark.parametrize("std", [0.2, 1.0, 3.0])
def test_papers_stochastic_relation_is_off_by_this_much(std: float) -> None:
    """Its error is 2 t (1 - t) times the score: none at the ends, all of it at t = 1/2."""
    interpolant = StochasticInterpolant()
    times, x = interior_times(interpolant), th.randn(9, 2, dtype=th.float64)
    velocity, score = gaussian_velocity_and_score(interpolant, times, x, mean=0.7, std=std)
    c, a, b = (k.unsqueeze(-1) for k in interpolant.score_coefficients(times))
    error = (a * velocity - b * x) - c * score
    t = times.unsqueeze(-1)
    th.testing.assert_close(error, 2 * t * (1 - t) * score)
    th.testing.assert_close(error[4], c[4] * score[4])


@pytest.mark.parametrize("name", EXACT)
def test_brownian_residual_is_its_coefficient_times_velocity_plus_score(name: str) -> None:
    interpolant = INTERPOLANTS[name]()
    times, x = interior_times(interpolant), th.randn(9, 2, dtype=th.float64)
    old_velocity, score = gaussian_velocity_and_score(interpolant, times, x, mean=-0.4, std=0.5)
    velocity = th.randn(9, 2, dtype=th.float64)
    eta = interpolant.brownian_residual(velocity, old_velocity, x, times)
    coefficient = interpolant.score_coefficients(times).score.unsqueeze(-1)
    th.testing.assert_close(eta, coefficient * (velocity + score))


@pytest.mark.parametrize("name", ["rectified", "trigflow"])
@pytest.mark.parametrize("latent_std", [0.1, 0.5, 2.0])
def test_brownian_residual_with_narrower_and_wider_latents(name: str, latent_std: float) -> None:
    interpolant = INTERPOLANTS[name]()
    times, x = interior_times(interpolant), th.randn(9, 2, dtype=th.float64)
    old_velocity, score = gaussian_velocity_and_score(interpolant, times, x, -0.4, 0.5, latent_std)
    velocity = th.randn(9, 2, dtype=th.float64)
    eta = interpolant.brownian_residual(velocity, old_velocity, x, times, latent_std)
    coefficient = interpolant.score_coefficients(times).score.unsqueeze(-1)
    th.testing.assert_close(eta, coefficient * (velocity + latent_std**2 * score) / latent_std)

    # The latents are the unit of length: it is the same with other units.
    lengths = (velocity, old_velocity, x)
    same = interpolant.brownian_residual(*(k / latent_std for k in lengths), times)
    th.testing.assert_close(eta, same)


def test_brownian_residual_vanishes_for_minus_the_score() -> None:
    interpolant = INTERPOLANTS["rectified"]()
    times, x = interior_times(interpolant), th.randn(9, 2, dtype=th.float64)
    old_velocity, score = gaussian_velocity_and_score(interpolant, times, x, mean=1.0, std=2.0)
    eta = interpolant.brownian_residual(-score, old_velocity, x, times)
    th.testing.assert_close(eta, th.zeros_like(eta))


def test_rectified_residual_by_hand() -> None:
    """(1 - t) v - (x - t v_old) = 0.25 * 2 - (3 - 0.75 * 4) = 0.5."""
    eta = INTERPOLANTS["rectified"]().brownian_residual(
        th.tensor([[2.0]]), th.tensor([[4.0]]), th.tensor([[3.0]]), th.tensor([0.75])
    )
    assert eta.item() == 0.5
