"""Laws of FPO's objective."""

from typing import Any

import pytest
import torch as th

from sb3_policyflow import FPO
from sb3_policyflow.common.losses import SURROGATES
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.tree import rows
from sb3_policyflow.common.update import UpdateMetrics
from sb3_policyflow.fpo.fpo import FPOUpdate, MonteCarloSamples
from sb3_policyflow.fpo.policies import FPOPolicy
from tests.helpers import collected, perturb


def with_draws(**options: Any) -> tuple[FPO, FlowRolloutBufferSamples]:
    """A model with a rollout and what its first epoch draws."""
    model, rollout = collected(FPO, **options)
    return model, rollout._replace(drawn=FPOUpdate(model, rollout).draw())


def log_ratio(model: FPO, batch: FlowRolloutBufferSamples) -> th.Tensor:
    features = model.policy.actor_features(batch.observations)
    return FPOUpdate(model, batch).terms(batch, features).log_ratio


@pytest.mark.parametrize("mc_average", ["loss", "objective"])
@pytest.mark.parametrize("loss_target", ["epsilon", "velocity"])
def test_ratio_is_one_at_equal_weights(mc_average: str, loss_target: str) -> None:
    model, rollout = with_draws(mc_average=mc_average, loss_target=loss_target)
    for batch in model.rollout_buffer.minibatches(rollout, 16):
        ratio = log_ratio(model, batch).exp()
        assert ratio.shape == ((16,) if mc_average == "loss" else (16, 8))
        # The same numbers up to rounding, which depends on the size of a batch.
        th.testing.assert_close(ratio, th.ones_like(ratio), atol=1e-5, rtol=0)


def test_ratio_does_not_depend_on_how_the_batch_is_split() -> None:
    model, rollout = with_draws()
    perturb(model.policy.velocity, 0.05)
    whole = log_ratio(model, rollout)
    assert whole.abs().min() > 1e-5
    for size in (1, 7, 32):
        chunks = [slice(start, start + size) for start in range(0, 64, size)]
        parts = th.cat([log_ratio(model, rows(rollout, chunk)) for chunk in chunks])
        th.testing.assert_close(parts, whole, atol=1e-5, rtol=1e-4)


def test_ratio_by_hand() -> None:
    """a = 3, eps = 1, t = 1/2: x_t = 2 and the target is 2; a velocity of 5 is wrong by 3."""
    losses = {"velocity": 9.0, "epsilon": 0.25 * 9.0}
    for target, expected in losses.items():
        model, rollout = with_draws(loss_target=target, n_mc_samples=1)
        with th.no_grad():
            model.policy.velocity.output.weight.zero_()
            model.policy.velocity.output.bias.fill_(5.0)
        drawn = MonteCarloSamples(th.full((64, 1), 0.5), th.ones(64, 1, 1), th.full((64, 1), 10.0))
        batch = rollout._replace(actions=th.full((64, 1), 3.0), drawn=drawn)
        th.testing.assert_close(log_ratio(model, batch), th.full((64,), 10.0 - expected))


def test_epsilon_is_the_noise_that_the_velocity_stands_for() -> None:
    """FPO's time is 1 - t and its velocity u = -v: its eps-hat is x + (1 - tau) u = x - t v."""
    model, rollout = with_draws(loss_target="epsilon", n_mc_samples=3)
    drawn: MonteCarloSamples = rollout.drawn
    times, noises = drawn.times.unsqueeze(-1), drawn.noises
    points = (1 - times) * noises + times * rollout.actions.unsqueeze(1)
    with th.no_grad():
        features = model.policy.actor_features(rollout.observations)
        velocity = model.policy.velocity(points, drawn.times, features.unsqueeze(1))
    predicted = points - times * velocity
    expected = (noises - predicted).square().mean(-1)
    th.testing.assert_close(drawn.reference_losses, expected, atol=1e-5, rtol=1e-4)


def test_times_are_where_steps_start() -> None:
    _, rollout = with_draws(n_flow_steps=4, n_mc_samples=50)
    assert sorted(set(rollout.drawn.times.flatten().tolist())) == [0.0, 0.25, 0.5, 0.75]
    _, rollout = with_draws(n_flow_steps=4, n_mc_samples=50, time_sampler="uniform")
    assert len(set(rollout.drawn.times.flatten().tolist())) > 1000


def test_losses_and_differences_are_clamped() -> None:
    model, rollout = with_draws(loss_clamp=0.5, difference_clamp=0.25, mc_average="objective")
    assert rollout.drawn.reference_losses.max().item() == 0.5
    perturb(model.policy.velocity, 1.0)
    assert log_ratio(model, rollout).abs().max().item() == 0.25


@pytest.mark.parametrize("mc_average", ["loss", "objective"])
def test_the_greatest_log_ratio_is_logged_as_it_was_before_the_clamp(mc_average: str) -> None:
    model, rollout = with_draws(mc_average=mc_average)
    perturb(model.policy.velocity, 1.0)
    expected = log_ratio(model, rollout).abs().max().item()
    model.difference_clamp = 0.25
    assert log_ratio(model, rollout).abs().max().item() <= 0.25 < expected
    metrics = UpdateMetrics()
    FPOUpdate(model, rollout).loss(rollout, metrics)
    assert metrics.summary()["log_ratio_max"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.0, 2.0, 2.0),
        (1.5, 2.0, 2.2),  # clipped at 1.1
        (0.5, 2.0, 1.0),  # not clipped: the loss is greater
        (1.0, -2.0, -2.0),
        (0.9, -2.0, -1.9),  # -1.8 - 2 / 0.2 * 0.01: as good as it gets
        (1.5, -2.0, -5.5),  # -3 - 2 / 0.2 * 0.25
        (0.5, -2.0, -3.5),  # -1 - 2 / 0.2 * 0.25: pulled back, where PPO has no gradient
    ],
)
def test_aspo_by_hand(ratio: float, advantage: float, expected: float) -> None:
    objective = SURROGATES["aspo"](th.tensor(ratio).log(), th.tensor(advantage), 0.1)
    assert objective.item() == pytest.approx(expected, rel=1e-5)


def test_spo_is_best_at_the_edge_of_the_trust_region() -> None:
    for advantage, edge in [(2.0, 1.1), (-2.0, 0.9)]:
        log_ratio = th.tensor(edge).log().requires_grad_()
        SURROGATES["spo"](log_ratio, th.tensor(advantage), 0.1).backward()
        assert log_ratio.grad is not None
        assert log_ratio.grad.item() == pytest.approx(0.0, abs=1e-5)


def test_noise_on_top_of_the_flow() -> None:
    stds = []
    for std in (0.0, 0.5):
        model = FPO("MlpPolicy", "Pendulum-v1", action_noise_std=std, seed=0)
        policy = model.policy
        assert isinstance(policy, FPOPolicy)
        with th.no_grad():
            policy.velocity.output.weight.zero_()
            actions, _ = policy.sample_actions(th.zeros(20_000, 3))
        stds.append(actions.std().item())
    assert stds[0] == pytest.approx(1.0, abs=0.02)
    assert stds[1] == pytest.approx(1.25**0.5, abs=0.02)


def test_record_is_empty() -> None:
    model, rollout = with_draws()
    assert rollout.record == ()
    assert model.rollout_buffer.actions.shape == (64, 1, 1)
