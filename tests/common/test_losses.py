"""The terms of the objective against torch.distributions and numbers computed by hand."""

import math

import pytest
import torch as th
from torch.distributions import Independent, Normal, kl_divergence

from sb3_policyflow.common.losses import (
    clipped_surrogate,
    gaussian_entropy,
    gaussian_kl,
    shifted_gaussian_log_ratio,
)


def draws() -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
    noise, shift = th.randn(2, 11, 3, dtype=th.float64)
    log_std, old_log_std = 0.3 * th.randn(2, 3, dtype=th.float64)
    return noise, shift, log_std, old_log_std


def test_log_ratio_equals_that_of_two_normals_around_the_endpoint() -> None:
    noise, shift, log_std, old_log_std = draws()
    endpoints = th.randn(11, 3, dtype=th.float64)
    actions = endpoints + noise
    new = Independent(Normal(endpoints + shift, log_std.exp()), 1).log_prob(actions)
    old = Independent(Normal(endpoints, old_log_std.exp()), 1).log_prob(actions)
    th.testing.assert_close(
        shifted_gaussian_log_ratio(noise, shift, log_std, old_log_std), new - old
    )


def test_kl_equals_that_of_two_normals() -> None:
    _, shift, log_std, old_log_std = draws()
    old = Independent(Normal(th.zeros_like(shift), old_log_std.exp()), 1)
    new = Independent(Normal(shift, log_std.exp()), 1)
    th.testing.assert_close(gaussian_kl(shift, log_std, old_log_std), kl_divergence(old, new))


def test_entropy_equals_that_of_a_normal() -> None:
    _, _, log_std, _ = draws()
    expected = Independent(Normal(th.zeros_like(log_std), log_std.exp()), 1).entropy()
    th.testing.assert_close(gaussian_entropy(log_std), expected)


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_no_change_gives_exactly_zero(dtype: th.dtype) -> None:
    noise, log_std = th.randn(1000, 5, dtype=dtype), th.randn(5, dtype=dtype)
    shift = th.zeros_like(noise)
    zeros = th.zeros(1000, dtype=dtype)
    assert th.equal(shifted_gaussian_log_ratio(noise, shift, log_std, log_std), zeros)
    assert th.equal(gaussian_kl(shift, log_std, log_std), zeros)


def test_log_ratio_by_hand() -> None:
    """Noise 2, shift 1, stds 1 then 2: (2^2 / 2) - (1^2 / 8 + log 2)."""
    ratio = shifted_gaussian_log_ratio(
        th.tensor([[2.0]]), th.tensor([[1.0]]), th.tensor([math.log(2.0)]), th.zeros(1)
    )
    assert ratio.item() == pytest.approx(2 - 0.125 - math.log(2), abs=1e-6)


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective"),
    [(1.5, 1.0, 1.2), (1.5, -1.0, -1.5), (0.5, 1.0, 0.5), (0.5, -1.0, -0.8), (1.1, 2.0, 2.2)],
)
def test_clipped_surrogate_by_hand(ratio: float, advantage: float, objective: float) -> None:
    value = clipped_surrogate(th.tensor([math.log(ratio)]), th.tensor([advantage]), 0.2)
    assert value.item() == pytest.approx(objective, abs=1e-6)
