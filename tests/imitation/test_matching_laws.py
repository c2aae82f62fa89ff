"""Flow matching and denoising: what their losses are at best, and what a trained policy draws."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.flows import INTERPOLANTS, Interpolant, MatchingSamples, draw_matching
from sb3_policyflow.flows.denoising import DDPM, EulerChain
from sb3_policyflow.imitation import clone
from tests.helpers import TINY

N = 400_000
MEAN, STD, LATENT_STD = 0.7, 0.5, 0.8
"""Of Gaussian end points, and of the latents."""


def gaussian(n: int = N) -> th.Tensor:
    th.manual_seed(0)
    return MEAN + STD * th.randn(n, 1, dtype=th.float64)


def exact_velocity(interpolant: Interpolant, drawn: MatchingSamples) -> th.Tensor:
    """The mean of dx_t/dt given x_t, for Gaussian end points and latents."""
    at, change = (
        interpolant.coefficients(drawn.times),
        interpolant.derivative_coefficients(drawn.times),
    )
    parts = (LATENT_STD**2, STD**2, 1.0)
    variance = sum(v * a**2 for v, a in zip(parts, at, strict=True))
    covariance = sum(v * a * c for v, a, c in zip(parts, at, change, strict=True))
    offset = drawn.points.squeeze(-1) - MEAN * at.endpoint
    return (MEAN * change.endpoint + covariance / variance * offset).unsqueeze(-1)


# With s and l the two deviations, the target's variance given x_t is s^2 l^2 / Var x_t.
@pytest.mark.parametrize(
    ("name", "least"),
    [("rectified", math.pi / 2 * STD * LATENT_STD), ("trigflow", STD * LATENT_STD)],
)
def test_the_exact_field_of_a_gaussian_has_the_least_loss(name: str, least: float) -> None:
    interpolant = INTERPOLANTS[name]()
    drawn = draw_matching(interpolant, gaussian(), LATENT_STD)
    error = exact_velocity(interpolant, drawn) - drawn.targets
    assert error.square().mean().item() == pytest.approx(least, rel=0.01)
    assert th.equal(drawn.weights, th.ones_like(drawn.weights))


@pytest.mark.parametrize("name", INTERPOLANTS)
def test_no_other_field_has_less(name: str) -> None:
    """The loss is stationary at the exact field, in the direction of any function of x_t and t."""
    interpolant = INTERPOLANTS[name]()
    global_std = 1.0 if interpolant.stochastic else LATENT_STD
    th.manual_seed(0)
    endpoints = MEAN + STD * th.randn(N, 1, dtype=th.float64)
    drawn = draw_matching(interpolant, endpoints, global_std)
    if interpolant.stochastic:  # Its latents have a deviation of 1.
        at = interpolant.coefficients(drawn.times)
        change = interpolant.derivative_coefficients(drawn.times)
        parts = (1.0, STD**2, 1.0)
        variance = sum(v * a**2 for v, a in zip(parts, at, strict=True))
        covariance = sum(v * a * c for v, a, c in zip(parts, at, change, strict=True))
        offset = drawn.points.squeeze(-1) - MEAN * at.endpoint
        exact = (MEAN * change.endpoint + covariance / variance * offset).unsqueeze(-1)
    else:
        exact = exact_velocity(interpolant, drawn)
    error = drawn.weights.unsqueeze(-1) * (drawn.targets - exact)
    times = drawn.times.unsqueeze(-1)
    for direction in (th.ones_like(times), drawn.points, times * drawn.points, drawn.points**2):
        slope = (error * direction).mean() / (
            error.square().mean() * direction.square().mean()
        ).sqrt()
        assert abs(slope.item()) < 4 / math.sqrt(N)


def test_denoising_a_gaussian() -> None:
    """Given x = sqrt(abar) a + sqrt(1 - abar) e, a ~ N(0, s^2), e varies by s^2 abar / Var x."""
    chain = DDPM(4, identity_skip=False).double()
    alpha_bars = 1 / chain._point_to_data.double() ** 2  # type: ignore[operator]
    data = gaussian() - MEAN
    drawn = chain.draw_matching(data)
    for step, alpha_bar in enumerate(alpha_bars.tolist()):
        chosen = (drawn.times - step / 4).abs() < 1e-6
        x, noise = drawn.points[chosen], drawn.targets[chosen]
        variance = alpha_bar * STD**2 + 1 - alpha_bar
        exact = math.sqrt(1 - alpha_bar) / variance * x
        assert x.var().item() == pytest.approx(variance, rel=0.03)
        left = (noise - exact).square().mean().item()
        assert left == pytest.approx(STD**2 * alpha_bar / variance, rel=0.03)


def test_the_skip_takes_the_points_from_what_is_wanted() -> None:
    data = th.rand(64, 2) - 0.5
    th.manual_seed(0)
    plain = DDPM(4, identity_skip=False).draw_matching(data)
    th.manual_seed(0)
    skipped = DDPM(4, identity_skip=True).draw_matching(data)
    assert th.allclose(skipped.targets + skipped.points, plain.targets, atol=1e-6)


@pytest.mark.parametrize("chain", [DDPM(8), EulerChain(8)])
def test_gains_turn_outputs_into_steps_of_the_mean(chain: Any) -> None:
    data = 0.01 * (th.rand(64, 2) - 0.5)  # far from the clip of the data
    drawn = chain.draw_matching(data)
    steps = (drawn.times * 8).round().long()
    before = chain.means(drawn.points, drawn.targets, steps)
    after = chain.means(drawn.points, drawn.targets + 1e-3, steps)
    expected = drawn.gains.unsqueeze(-1) * 1e-3 / 8
    assert th.allclose((after - before).abs(), expected.expand(-1, 2), rtol=1e-2, atol=1e-6)


def test_wanted_outputs_lead_to_the_data() -> None:
    """From the points of its last step, a chain that knows the noise steps to the data."""
    for chain in (DDPM(6, identity_skip=True), DDPM(6, identity_skip=False)):
        data = th.rand(256, 2) - 0.5
        drawn = chain.draw_matching(data)
        last = drawn.times > 0.8
        means = chain.means(drawn.points[last], drawn.targets[last], 5)
        assert th.allclose(means, data[last], atol=1e-4)


# What a cloned policy draws

CENTERS = th.tensor([[-2.0, 1.0], [2.0, 0.0]])
WEIGHTS = {-1.0: 0.3, 1.0: 0.6}
"""Of the first center, where the first number observed is the key."""


def mixture(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations, and actions of which a share that depends on them is near each center."""
    rng = np.random.default_rng(0)
    signs = rng.choice(list(WEIGHTS), size=n)
    is_first = rng.random(n) < np.vectorize(WEIGHTS.get)(signs)
    actions = np.where(is_first[:, None], *CENTERS.numpy()) + 0.3 * rng.standard_normal((n, 2))
    observations = np.zeros((n, 4), dtype=np.float32)
    observations[:, 0] = signs
    return observations, actions.astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (PolicyFlow, {"interpolant": "trigflow", "latent_std": 0.5}),
        (FPO, {"solver": "midpoint"}),
        (DPPO, {"process": "flow", "n_denoising_steps": 20, "min_sampling_std": 1e-3}),
    ],
)
def test_a_mixture_that_depends_on_the_observation(
    algorithm: type[Any], options: dict[str, Any]
) -> None:
    policy_kwargs = {"net_arch": [64, 64], "activation_fn": th.nn.Mish, "embedding_dim": 16}
    model = algorithm("MlpPolicy", "MultiGoal-v0", policy_kwargs=policy_kwargs, seed=0, **options)
    clone(
        model,
        mixture(30_000),
        gradient_steps=2000,
        learning_rate="lin_0.003",
        validation_fraction=0,
        **({"noise_std": 1e-3} if algorithm is PolicyFlow else {}),
    )
    th.manual_seed(1)
    for sign, weight in WEIGHTS.items():
        observations = np.zeros((40_000, 4), dtype=np.float32)
        observations[:, 0] = sign
        actions = th.as_tensor(model.predict(observations)[0])
        nearest = th.cdist(actions, CENTERS).argmin(dim=1)
        assert (nearest == 0).float().mean().item() == pytest.approx(weight, abs=0.03)
        for index, center in enumerate(CENTERS):
            of_mode = actions[nearest == index]
            assert (of_mode.mean(dim=0) - center).norm().item() < 0.1
            assert of_mode.std(dim=0).tolist() == pytest.approx([0.3, 0.3], abs=0.1)


def act(observations: np.ndarray) -> np.ndarray:
    """A demonstrator that draws nothing."""
    return 3 * np.tanh(observations @ np.array([[1.0, 0.2], [0.0, -1.0], [0.5, 0.0], [0.0, 0.3]]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (PolicyFlow, {}),
        (PolicyFlow, {"gaussian": True, "n_flow_steps": 2}),
        (PolicyFlow, {"interpolant": "stochastic"}),
        (FPO, {}),
        (DPPO, {"process": "ddpm"}),
        (DPPO, {"process": "flow"}),
    ],
)
def test_actions_without_chance_are_reproduced(
    algorithm: type[Any], options: dict[str, Any]
) -> None:
    rng = np.random.default_rng(0)
    observations = rng.standard_normal((8192, 4)).astype(np.float32)
    policy_kwargs = {"net_arch": [64, 64], "activation_fn": th.nn.Mish, "embedding_dim": 16}
    model = algorithm("MlpPolicy", "MultiGoal-v0", policy_kwargs=policy_kwargs, seed=0, **options)
    clone(
        model,
        (observations, act(observations)),
        gradient_steps=1000,
        batch_size=256,
        learning_rate="lin_0.005",
    )
    unseen = rng.standard_normal((1000, 4)).astype(np.float32)
    error = model.predict(unseen, deterministic=True)[0] - act(unseen)
    assert np.sqrt(np.mean(error**2)) < 0.15  # actions deviate by 1.9


def test_matching_is_not_of_the_tiny_policy_alone() -> None:
    """A policy of several action dimensions draws points of their shape."""
    model = PolicyFlow("MlpPolicy", "MultiGoal-v0", policy_kwargs=TINY)
    drawn = model.policy.draw_matching(th.zeros(5, 2))
    assert drawn.points.shape == drawn.targets.shape == (5, 2)
    assert drawn.times.shape == (5,)
