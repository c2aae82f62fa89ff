"""Laws of PolicyFlow's objective, in float64."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn
from torch.distributions import Independent, Normal

from sb3_policyflow import PolicyFlow
from sb3_policyflow.common.losses import clipped_surrogate
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.policyflow.policies import PolicyFlowPolicy, PolicyFlowRecord
from sb3_policyflow.policyflow.policyflow import PathSamples, PolicyFlowUpdate
from tests.helpers import learned, perturb

N_SAMPLES = 16


class DoubleExtractor(FlattenExtractor):
    """SB3 makes observations single precision, whatever the precision of the policy."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations).double()


def tiny_model(**options: Any) -> PolicyFlow:
    """A PolicyFlow in float64 whose velocity is not zero."""
    policy_kwargs = {
        "net_arch": {"pi": [4], "vf": [4]},
        "embedding_dim": 4,
        "initialization": "glorot",
        "activation_fn": nn.SiLU,
        "features_extractor_class": DoubleExtractor,
        **options.pop("policy_kwargs", {}),
    }
    options = {"latent_std": 1.0, **options}  # the paper's
    model = PolicyFlow(
        "MlpFlowPolicy",
        "Pendulum-v1",
        n_steps=N_SAMPLES,
        batch_size=N_SAMPLES,
        seed=0,
        policy_kwargs=policy_kwargs,
        **options,
    )
    model.policy.double()
    return model


def sample_batch(
    model: PolicyFlow,
) -> tuple[FlowRolloutBufferSamples, th.Tensor, PolicyFlowUpdate]:
    """A batch sampled from the model's policy, its features and its update."""
    observations = th.randn(N_SAMPLES, 3)
    features = model.policy.actor_features(observations)
    with th.no_grad():
        actions, record = model.policy.sample_actions(features)
    batch = FlowRolloutBufferSamples(
        observations=observations,
        actions=actions,
        old_values=th.zeros(N_SAMPLES, dtype=th.float64),
        advantages=th.randn(N_SAMPLES, dtype=th.float64),
        returns=th.randn(N_SAMPLES, dtype=th.float64),
        record=record,
    )
    update = PolicyFlowUpdate(model, batch)
    return batch._replace(drawn=update.draw()), features, update


@pytest.mark.parametrize("interpolant", ["rectified", "stochastic", "trigflow"])
@pytest.mark.parametrize("n_times", [1, 3])
def test_nothing_has_changed_before_the_first_step(interpolant: str, n_times: int) -> None:
    model = tiny_model(interpolant=interpolant, n_times=n_times)
    batch, features, update = sample_batch(model)
    terms = update.terms(batch, features)
    assert th.equal(terms.log_ratio, th.zeros(N_SAMPLES, n_times, dtype=th.float64))
    assert terms.kl.item() == 0.0
    assert terms.metrics["velocity_change"].item() == 0.0


def test_ratio_is_that_of_the_shifted_gaussian() -> None:
    model = tiny_model()
    batch, features, update = sample_batch(model)
    perturb(model.policy, 0.05)
    terms = update.terms(batch, features)
    drawn: PathSamples = batch.drawn
    with th.no_grad():
        new_velocity = model.policy.velocity(drawn.points[:, 0], drawn.times[:, 0], features)
        change = new_velocity - drawn.reference_velocity[:, 0]
        noise = batch.actions - batch.record.endpoints
        new = Independent(Normal(change, model.policy.log_std.exp()), 1).log_prob(noise)
        old = Independent(Normal(th.zeros_like(noise), update.reference_log_std.exp()), 1).log_prob(
            noise
        )
    th.testing.assert_close(terms.log_ratio[:, 0], new - old)
    assert terms.log_ratio.abs().min() > 0


def test_trigflow_shifts_by_half_pi_times_the_mean_velocity_change() -> None:
    """A velocity that grows by a constant moves the end point by (pi/2) times it, exactly."""
    model = tiny_model(interpolant="trigflow", time_average="shift", n_times=2, n_flow_steps=5)
    batch, features, update = sample_batch(model)
    change = th.tensor([0.01], dtype=th.float64)
    with th.no_grad():
        model.policy.velocity.output.weight.zero_()
        before = model.policy.transport(batch.record.latents, features)
        update = PolicyFlowUpdate(model, batch)
        batch = batch._replace(drawn=update.draw())
        model.policy.velocity.output.bias += change
        true_shift = model.policy.transport(batch.record.latents, features) - before
    terms = update.terms(batch, features)
    noise = batch.actions - batch.record.endpoints
    log_std = model.policy.log_std
    new = Independent(Normal(true_shift, log_std.exp()), 1).log_prob(noise)
    old = Independent(Normal(th.zeros_like(noise), log_std.exp()), 1).log_prob(noise)
    th.testing.assert_close(terms.log_ratio[:, 0], new - old)


def test_equals_gaussian_ppo_when_the_reference_velocity_and_the_latents_are_zero() -> None:
    """With z = phi = 0 and v_ref = 0 the new velocity is the mean of PPO's Gaussian."""
    model = tiny_model(policy_kwargs={"initialization": "glorot_zero_output"}, ent_coef=0.01)
    batch, features, update = sample_batch(model)
    zeros = th.zeros_like(batch.actions)
    batch = batch._replace(record=PolicyFlowRecord(zeros, zeros), actions=th.randn_like(zeros))
    update = PolicyFlowUpdate(model, batch)
    batch = batch._replace(drawn=update.draw())
    perturb(model.policy, 0.05)
    advantages, parameters = batch.advantages, actor_parameters(model)

    terms = update.terms(batch, features)
    ours = -clipped_surrogate(terms.log_ratio[:, 0], advantages, 0.2).mean() + terms.regularizer

    means = model.policy.velocity(zeros, batch.drawn.times[:, 0], features)
    gaussian = Independent(Normal(means, model.policy.log_std.exp()), 1)
    standard = Independent(Normal(zeros, th.ones_like(zeros)), 1)
    ratio = (gaussian.log_prob(batch.actions) - standard.log_prob(batch.actions)).exp()
    objective = th.min(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages)
    theirs = -objective.mean() - 0.01 * gaussian.entropy().mean()

    th.testing.assert_close(ours, theirs)
    for our_gradient, their_gradient in zip(
        th.autograd.grad(ours, parameters), th.autograd.grad(theirs, parameters), strict=True
    ):
        th.testing.assert_close(our_gradient, their_gradient)


def actor_parameters(model: PolicyFlow) -> list[nn.Parameter]:
    return [*learned(model.policy.velocity), model.policy.log_std]


@pytest.mark.parametrize("interpolant", ["rectified", "stochastic", "trigflow"])
def test_gradient_equals_finite_differences_for_every_parameter(interpolant: str) -> None:
    model = tiny_model(interpolant=interpolant, brownian_coef=0.25, ent_coef=0.01, n_times=2)
    batch, features, update = sample_batch(model)
    perturb(model.policy, 0.02)

    def loss() -> th.Tensor:
        terms = update.terms(batch, features)
        objective = clipped_surrogate(terms.log_ratio, batch.advantages.unsqueeze(1), 0.2)
        return -objective.mean() + terms.regularizer

    parameters = actor_parameters(model)
    gradients = th.autograd.grad(loss(), parameters)
    assert sum(parameter.numel() for parameter in parameters) > 60
    for parameter, gradient in zip(parameters, gradients, strict=True):
        th.testing.assert_close(gradient, finite_differences(loss, parameter), atol=1e-7, rtol=1e-5)


def finite_differences(loss: Any, parameter: th.Tensor, step: float = 1e-6) -> th.Tensor:
    slopes = th.zeros_like(parameter)
    flat, flat_slopes = parameter.detach().view(-1), slopes.view(-1)
    for index in range(len(flat)):
        center = flat[index].item()
        values = []
        for sign in (1, -1):
            flat[index] = center + sign * step
            values.append(loss().item())
        flat[index] = center
        flat_slopes[index] = (values[0] - values[1]) / (2 * step)
    return slopes


BY_HAND = PathSamples(
    times=th.tensor([[0.5]]),
    points=th.tensor([[[3.0, 1.0]]]),
    reference_velocity=th.tensor([[[2.0, 0.0]]]),
)


def test_brownian_loss_by_hand() -> None:
    """Straight path at t = 1/2 with x = (3, 1), v_ref = (2, 0), v = (4, 2): eta = (0, 0)."""
    _, _, update = sample_batch(tiny_model())
    assert update.brownian_loss(BY_HAND, th.tensor([[[4.0, 2.0]]])).item() == 0.0
    # v = (8, 2): eta = (2, 0); the squared norm is 4, its mean over dimensions 2.
    assert update.brownian_loss(BY_HAND, th.tensor([[[8.0, 2.0]]])).item() == 4.0
    _, _, update = sample_batch(tiny_model(brownian_reduction="mean"))
    assert update.brownian_loss(BY_HAND, th.tensor([[[8.0, 2.0]]])).item() == 2.0


def test_brownian_loss_by_hand_with_narrower_latents() -> None:
    """With s = 1/2: eta = (v / 2 - (x - v_ref / 2)) / s = 2 ((4, 1) - (2, 1)) = (4, 0)."""
    _, _, update = sample_batch(tiny_model(latent_std=0.5))
    assert update.brownian_loss(BY_HAND, th.tensor([[[8.0, 2.0]]])).item() == 16.0


def test_latents_have_their_standard_deviation() -> None:
    policy = tiny_model(latent_std=0.2).policy
    features = th.zeros(20_000, 3, dtype=th.float64)
    with th.no_grad():
        _, record = policy.sample_actions(features)
        assert record.latents.std().item() == pytest.approx(0.2, rel=0.03)
        th.testing.assert_close(record.endpoints, policy.transport(record.latents, features))
        policy.deterministic_action = "zero"
        _, record = policy.sample_actions(features, deterministic=True)
    assert not record.latents.any()


def test_latents_are_in_proportion_to_the_action_space() -> None:
    """A fifth of half the distance of the bounds, or the paper's 1 where they mean nothing."""
    low, high = np.array([-1, -2, 0, -np.inf, -1e3], np.float32), np.array([1, 2, 3, 1, 1e3])
    space = spaces.Box(low, high.astype(np.float32))
    policy = PolicyFlowPolicy(spaces.Box(-1, 1, (3,)), space, lambda _: 1e-3)
    expected = th.tensor([0.2, 0.4, 0.3, 1.0, 1.0])
    th.testing.assert_close(policy.latent_scale, expected)
    latents, _ = policy.draw_latents(th.zeros(50_000, 3), deterministic=False)
    th.testing.assert_close(latents.std(dim=0), expected, rtol=0.02, atol=0)
    multigoal = PolicyFlowPolicy(spaces.Box(-1, 1, (4,)), spaces.Box(-5, 5, (2,)), lambda _: 1e-3)
    assert multigoal.latent_scale == 1.0
    policy.interpolant = "stochastic"
    assert policy.latent_scale == 1.0


def test_approximate_ratio_approaches_the_exact_one_for_small_updates() -> None:
    """The error of the shift is of first order in the update (paper, error analysis)."""
    errors = []
    for scale in (0.02, 0.01):
        model = tiny_model(n_times=64, time_average="shift")
        batch, features, _ = sample_batch(model)
        th.manual_seed(5)
        perturb(model.policy, scale)
        with th.no_grad():
            drawn: PathSamples = batch.drawn
            new = model.policy.velocity(drawn.points, drawn.times, features.unsqueeze(1))
            approximate = (new - drawn.reference_velocity).mean(1)
            exact = model.policy.transport(batch.record.latents, features) - batch.record.endpoints
        errors.append((approximate - exact).norm().item())
    assert errors[1] < 0.7 * errors[0]
