"""The entropy of actions that can only be drawn."""

import math

import pytest
import torch as th
from torch.distributions import Normal

from sb3_policyflow import FPO
from sb3_policyflow.common.entropy import SMALLEST_DISTANCE, nearest_neighbor_entropy


@pytest.mark.parametrize("dim", [1, 2, 5])
@pytest.mark.parametrize("std", [0.1, 3.0])
def test_entropy_of_gaussians(dim: int, std: float) -> None:
    samples = std * th.randn(400, 64, dim)
    exact = dim * Normal(0.0, std).entropy().item()
    # In more dimensions the tails bias it upwards.
    assert nearest_neighbor_entropy(samples).item() == pytest.approx(exact, abs=0.08 * dim)


@pytest.mark.parametrize("n_actions", [8, 64])
def test_entropy_does_not_depend_on_where_the_samples_are(n_actions: int) -> None:
    samples = 1e-3 * th.randn(200, n_actions, 2)
    entropies = [nearest_neighbor_entropy(samples + offset).item() for offset in (0.0, 5.0)]
    assert entropies[1] == pytest.approx(entropies[0], abs=0.02)


def test_two_samples_by_hand() -> None:
    """psi(2) - psi(1) = 1, the unit "ball" of the line is 2 long, both neighbors 3 away."""
    samples = th.tensor([[[0.0], [3.0]]])
    expected = 1 + math.log(2) + math.log(3)
    assert nearest_neighbor_entropy(samples).item() == pytest.approx(expected)


def test_gradient_spreads_the_samples() -> None:
    scale = th.ones((), requires_grad=True)
    nearest_neighbor_entropy(5 + scale * 1e-2 * th.randn(50, 32, 3)).backward()
    assert scale.grad is not None
    assert scale.grad.item() == pytest.approx(3.0, rel=1e-4)  # H(cX) = H(X) + d log c


def test_samples_that_coincide_have_a_finite_entropy_and_no_gradient() -> None:
    samples = th.zeros(2, 4, 1, requires_grad=True)
    entropy = nearest_neighbor_entropy(samples)
    assert entropy.item() < math.log(SMALLEST_DISTANCE) + 4
    entropy.backward()
    assert samples.grad is not None
    assert th.equal(samples.grad, th.zeros(2, 4, 1))


def test_the_bonus_makes_actions_more_different() -> None:
    """Without rewards to speak of, what is left of the loss is the entropy."""
    spreads = []
    for ent_coef in (0.0, 1.0):
        options = {"n_steps": 128, "batch_size": 32, "learning_rate": 3e-3, "seed": 0}
        model = FPO("MlpPolicy", "Pendulum-v1", ent_coef=ent_coef, **options).learn(128)
        with th.no_grad():
            features = th.zeros(500, 3)
            actions, _ = model.policy.sample_actions(features)
        spreads.append(actions.std().item())
    assert spreads[1] > 1.3 * spreads[0]
