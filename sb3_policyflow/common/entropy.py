"""The entropy of actions, for policies that can be sampled but have no likelihood."""

import math
from typing import Any, NamedTuple

import torch as th

from sb3_policyflow.common import checks
from sb3_policyflow.common.policies import FlowPolicy

SMALLEST_DISTANCE = 1e-6
"""Actions nearer than this count as this far apart: clipped ones may coincide."""


def nearest_neighbor_entropy(samples: th.Tensor) -> th.Tensor:
    """Differential entropy from the distances of samples to their nearest neighbors.

    H = psi(m) - psi(1) + log V_d + d / m sum_i log r_i    (Kozachenko and Leonenko, 1987)

    with V_d the volume of the unit ball. It has a gradient for samples that have one.

    >>> uniform = th.rand(1000, 32, 1, generator=th.Generator().manual_seed(0))
    >>> abs(nearest_neighbor_entropy(4 * uniform).item() - math.log(4)) < 0.05
    True

    :param samples: m samples from each of n distributions, shape (n, m, d) with m of at least 2.
    :return: The mean entropy in nats, a tensor without dimensions.
    """
    n_samples, dim = samples.shape[-2:]
    # The matrix product that torch prefers cancels where samples are close but far from 0.
    distances = th.cdist(samples, samples, compute_mode="donot_use_mm_for_euclid_dist")
    itself = th.eye(n_samples, dtype=th.bool, device=samples.device)
    nearest = distances.masked_fill(itself, math.inf).amin(dim=-1).clamp_min(SMALLEST_DISTANCE)
    log_ball = 0.5 * dim * math.log(math.pi) - math.lgamma(0.5 * dim + 1)
    harmonic = math.fsum(1 / i for i in range(1, n_samples))  # psi(m) - psi(1)
    return harmonic + log_ball + dim * nearest.log().mean()


def action_entropy(policy: FlowPolicy, features: th.Tensor, n_actions: int) -> th.Tensor:
    """Entropy of a policy's actions in nats, from several in each state, mean over the states.

    :param policy: The policy, through whose steps the entropy is differentiated.
    :param features: The actor's features of the states, shape (n, features_dim).
    :param n_actions: How many to draw in each, at least 2.
    """
    actions, _ = policy.sample_actions(features.repeat_interleave(n_actions, dim=0))
    return nearest_neighbor_entropy(actions.reshape(len(features), n_actions, -1))


ENTROPY_CHECKS: dict[str, checks.Check] = {
    "n_entropy_actions": checks.at_least(2),
    "n_entropy_states": checks.at_least(1),
}
"""Checks of the options that :meth:`EntropyBonus.of` reads."""


class EntropyBonus(NamedTuple):
    """Rewards the entropy of the actions, estimated from several actions in each of some states.

    It costs nothing while its coefficient is 0. The gradient goes through all the steps that make
    an action.

    :param coef: ``ent_coef`` at the present progress.
    :param n_actions: Actions drawn in each state.
    :param n_states: States of a minibatch in which they are drawn, at most.
    """

    coef: float
    n_actions: int
    n_states: int

    @classmethod
    def of(cls, algorithm: Any) -> "EntropyBonus":
        """The bonus in an algorithm's update; each rank takes its share of the states."""
        n_states = math.ceil(algorithm.n_entropy_states / algorithm.ranks.size)
        return cls(algorithm.value_of("ent_coef"), algorithm.n_entropy_actions, n_states)

    def regularizer(
        self, policy: FlowPolicy, features: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """What the entropy adds to the loss, and the metrics to log.

        :param policy: The policy.
        :param features: The actor's features of a minibatch in random order, (n, features_dim).
        """
        if self.coef == 0:
            return features.new_zeros(()), {}
        entropy = action_entropy(policy, features[: self.n_states], self.n_actions)
        return -self.coef * entropy, {"entropy_loss": -entropy}
