"""PolicyFlow's Gaussian mode, and flow matching towards uniform actions."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch.distributions import Independent, Normal

from sb3_policyflow import PolicyFlow
from sb3_policyflow.flows import INTERPOLANTS, Rectified, StochasticInterpolant, VelocityField
from sb3_policyflow.policyflow.policyflow import PolicyFlowUpdate
from sb3_policyflow.policyflow.uniform import UniformTargets
from tests.helpers import perturb

GAUSSIAN: dict[str, Any] = {
    "gaussian": True,
    "n_flow_steps": 1,
    "solver": "euler",
    "time_sampler": "grid_without_end",
}


def test_gaussian_mode_is_gaussian_ppo() -> None:
    """Ratio, divergence and entropy are those of N(v(0, 0, s), sigma^2), at any change."""
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=64, seed=0, ent_coef=0.01, **GAUSSIAN)
    policy = model.policy
    model.learn(64)
    rollout = model.rollout_buffer.samples()
    features = policy.actor_features(rollout.observations)
    zeros = th.zeros(64, 1)

    def gaussian() -> Independent:
        means = policy.velocity(zeros, th.zeros(64), features)
        return Independent(Normal(means, policy.log_std.exp()), 1)

    policy.set_training_mode(False)
    with th.no_grad():
        # The record is that of the policy before the update: sample one of the policy now.
        actions, record = policy.sample_actions(features)
        old = gaussian()
        rollout = rollout._replace(actions=actions, record=record)
        update = PolicyFlowUpdate(model, rollout)
        drawn = update.draw()
        perturb(policy, 0.05)
        terms = update.terms(rollout._replace(drawn=drawn), features)
        new = gaussian()
    assert th.equal(record.latents, zeros)
    th.testing.assert_close(record.endpoints, old.mean)
    expected = new.log_prob(actions) - old.log_prob(actions)
    th.testing.assert_close(terms.log_ratio[:, 0], expected, atol=1e-5, rtol=1e-4)
    divergence = th.distributions.kl_divergence(old, new).mean()
    th.testing.assert_close(terms.kl, divergence, atol=1e-6, rtol=1e-4)
    assert terms.regularizer.item() == pytest.approx(-0.01 * new.entropy().mean().item())


def test_gaussian_mode_has_no_flow_to_spread() -> None:
    for option in ("brownian_coef", "uniform_noise_coef"):
        with pytest.raises(ValueError, match="A Gaussian policy has no flow to spread"):
            PolicyFlow("MlpPolicy", "Pendulum-v1", **GAUSSIAN, **{option: 0.1})


@pytest.mark.parametrize("bound", [100.0, 1e10, float(np.finfo(np.float32).max)])
def test_uniform_targets_need_bounds(bound: float) -> None:
    with pytest.raises(ValueError, match="has no bounds if they are 200 or more apart"):
        UniformTargets(spaces.Box(-bound, bound, (2,)), Rectified())


@pytest.mark.parametrize("latent_std", [1.0, 0.4])
def test_uniform_targets_make_actions_uniform(latent_std: float) -> None:
    """A field trained on nothing else carries its latents to the uniform distribution."""
    box, features = spaces.Box(np.float32([-1, 2]), np.float32([3, 6])), 1
    field = VelocityField(2, features, net_arch=[64, 64])
    targets = UniformTargets(box, Rectified(), latent_std)
    optimizer = th.optim.Adam(field.parameters(), lr=3e-3)
    for _ in range(400):
        optimizer.zero_grad()
        targets.loss(field, th.zeros(256, features)).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    points = latent_std * th.randn(2000, 2)
    with th.no_grad():
        for step in range(20):
            points = points + field(points, th.tensor(step / 20), th.zeros(features)) / 20
    th.testing.assert_close(points.mean(0), th.tensor([1.0, 4.0]), atol=0.2, rtol=0)
    th.testing.assert_close(points.std(0), th.full((2,), 4 / 12**0.5), atol=0.2, rtol=0)
    assert points[:, 0].quantile(0.99).item() < 3.4


@pytest.mark.parametrize("name", ["rectified", "trigflow"])
def test_uniform_loss_vanishes_for_the_field_that_it_asks_for(name: str) -> None:
    """With a single action u the field dx/dt is a function of x and t, and meets the target."""
    interpolant = INTERPOLANTS[name]()
    box = spaces.Box(2.0, 2.0 + 1e-6, (1,))

    class Exact(VelocityField):
        def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
            latent, endpoint, _ = (c.unsqueeze(-1) for c in interpolant.coefficients(times))
            latents = (points - 2.0 * endpoint) / latent
            return interpolant.derivative(latents, th.full_like(points, 2.0), times)

    loss = UniformTargets(box, interpolant).loss(Exact(1, 1), th.zeros(1000, 1))
    assert loss.item() < 1e-3


def test_uniform_noise_is_added_to_the_loss_and_logged() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=64, uniform_noise_coef="lin_0.05")
    model.learn(128)
    assert model.logger.name_to_value["train/uniform_noise_loss"] > 0


def test_uniform_noise_needs_an_interpolant_without_noise() -> None:
    with pytest.raises(ValueError, match="interpolant without noise of its own"):
        UniformTargets(spaces.Box(-1, 1, (1,)), StochasticInterpolant())
    with pytest.raises(ValueError, match="interpolant without noise of its own"):
        PolicyFlow(
            "MlpPolicy", gym.make("Pendulum-v1"), interpolant="stochastic", uniform_noise_coef=0.1
        )
