"""The terms of the objective: pure functions of tensors, and the pull towards a cloned policy."""

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import torch as th
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.flows import MatchingSamples

SMALLEST_CLIP_RANGE = 1e-6
"""Epsilon of the penalties that divide by it, at least."""


def shifted_gaussian_log_ratio(
    noise: th.Tensor, shift: th.Tensor, log_std: th.Tensor, old_log_std: th.Tensor
) -> th.Tensor:
    """Log of the approximate importance ratio (paper, importance ratio from velocity changes).

    log rho = log N(n; delta, sigma^2) - log N(n; 0, sigma_old^2), summed over action dimensions

    >>> n, zero = th.tensor([[1.0]]), th.zeros(1)
    >>> shifted_gaussian_log_ratio(n, th.tensor([[1.0]]), zero, zero).item()  # 0 - (-1/2)
    0.5

    :param noise: n = a - phi, shape (..., action_dim).
    :param shift: delta, the change of the end point, shape (..., action_dim).
    :param log_std: log sigma now, shape (action_dim,).
    :param old_log_std: log sigma when the action was made, shape (action_dim,).
    :return: log rho, shape (...).
    """
    # Energies -log N without their constant, for each dimension
    new = 0.5 * ((noise - shift) / log_std.exp()) ** 2 + log_std
    old = 0.5 * (noise / old_log_std.exp()) ** 2 + old_log_std
    return (old - new).sum(dim=-1)


def gaussian_kl(shift: th.Tensor, log_std: th.Tensor, old_log_std: th.Tensor) -> th.Tensor:
    """KL(N(phi, sigma_old^2) || N(phi + delta, sigma^2)), summed over action dimensions.

    >>> zero = th.zeros(1)
    >>> gaussian_kl(th.tensor([[2.0]]), zero, zero).item()  # 2^2 / 2
    2.0

    :param shift: delta, shape (..., action_dim).
    :param log_std: log sigma now, shape (action_dim,).
    :param old_log_std: log sigma when the action was made, shape (action_dim,).
    :return: The divergence in nats, shape (...).
    """
    variance, old_variance = (2 * log_std).exp(), (2 * old_log_std).exp()
    spread = (old_variance + shift**2) / (2 * variance) - 0.5
    return (log_std - old_log_std + spread).sum(dim=-1)


def gaussian_entropy(log_std: th.Tensor) -> th.Tensor:
    """Entropy of the Gaussian noise (paper, second term of the entropy regularizer).

    1/2 sum_i log(2 pi e sigma_i^2)

    :param log_std: log sigma, shape (action_dim,).
    :return: The entropy in nats, a tensor without dimensions.
    """
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()


def clipped_surrogate(
    log_ratio: th.Tensor, advantages: th.Tensor, clip_range: float | th.Tensor
) -> th.Tensor:
    """PPO's clipped objective for each sample, to be maximized (paper, J^Flow).

    min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)

    >>> clipped_surrogate(th.tensor([1.0, -1.0]), th.tensor([1.0, 1.0]), 0.5)
    tensor([1.5000, 0.3679])

    :param log_ratio: log rho, shape (...).
    :param advantages: A, a shape that broadcasts with it.
    :param clip_range: epsilon, one number or a shape that broadcasts too.
    :return: The objective, shape (...).
    """
    ratio = log_ratio.exp()
    bounds: tuple[Any, Any] = (1 - clip_range, 1 + clip_range)  # of numbers, or of tensors
    clipped = ratio.clamp(*bounds)
    return th.min(ratio * advantages, clipped * advantages)


def penalized_surrogate(
    log_ratio: th.Tensor, advantages: th.Tensor, clip_range: float | th.Tensor
) -> th.Tensor:
    """SPO's objective for each sample, to be maximized (Xie et al., 2025).

    rho A - |A| / (2 epsilon) (rho - 1)^2,    greatest at rho = 1 + epsilon sign(A)

    >>> penalized_surrogate(th.tensor(2.0).log(), th.tensor([1.0, -1.0]), 0.5)
    tensor([ 1., -3.])

    Takes and returns the shapes of :func:`clipped_surrogate`.
    """
    ratio = log_ratio.exp()
    # A schedule may end at 0, where the old policy alone is allowed.
    if isinstance(clip_range, th.Tensor):
        width: th.Tensor | float = clip_range.clamp_min(SMALLEST_CLIP_RANGE)
    else:
        width = max(clip_range, SMALLEST_CLIP_RANGE)
    penalty: th.Tensor = advantages.abs() / (2 * width) * (ratio - 1) ** 2
    return ratio * advantages - penalty


def asymmetric_surrogate(
    log_ratio: th.Tensor, advantages: th.Tensor, clip_range: float | th.Tensor
) -> th.Tensor:
    """FPO++'s objective (ASPO, arXiv 2602.02481): PPO's where A >= 0, SPO's where A < 0.

    >>> asymmetric_surrogate(th.tensor(2.0).log(), th.tensor([1.0, -1.0]), 0.5)
    tensor([ 1.5000, -3.0000])

    Takes and returns the shapes of :func:`clipped_surrogate`.
    """
    arguments = log_ratio, advantages, clip_range
    return th.where(advantages < 0, penalized_surrogate(*arguments), clipped_surrogate(*arguments))


SURROGATES: dict[str, Callable[[th.Tensor, th.Tensor, float | th.Tensor], th.Tensor]] = {
    "ppo": clipped_surrogate,
    "spo": penalized_surrogate,
    "aspo": asymmetric_surrogate,
}
"""Objectives that keep the policy near the old one, by the name of their trust region."""


def clipped_value_loss(
    values: th.Tensor, old_values: th.Tensor, returns: th.Tensor, clip_range: float | None
) -> th.Tensor:
    """Mean squared error of the values, whose change is clipped as in SB3's PPO.

    >>> one, three = th.ones(1), th.full((1,), 3.0)
    >>> [clipped_value_loss(three, one, one, epsilon).item() for epsilon in (None, 0.5)]
    [4.0, 0.25]

    :param values: Shape (n,).
    :param old_values: Those of the rollout, shape (n,).
    :param returns: The TD(lambda) returns, shape (n,).
    :param clip_range: Greatest change of a value; None for no clipping.
    """
    if clip_range is not None:
        values = old_values + (values - old_values).clamp(-clip_range, clip_range)
    return F.mse_loss(returns, values)


def ratio_divergence(log_ratio: th.Tensor) -> th.Tensor:
    """KL(old || new) in nats, estimated from importance ratios as SB3's PPO does.

    mean of rho - 1 - log rho    (Schulman, "Approximating KL divergence")

    >>> round(ratio_divergence(th.tensor([1.0, 3.0]).log()).item(), 4)  # (2 - log 3) / 2
    0.4507

    :param log_ratio: log rho, shape (...).
    :return: The divergence, a tensor without dimensions.
    """
    return (th.expm1(log_ratio) - log_ratio).mean()


def matched_outputs(policy: Any, drawn: MatchingSamples, features: th.Tensor) -> th.Tensor:
    """What a policy's network says at the points of flow matching, shape (n, action_dim).

    :param policy: The policy.
    :param drawn: The points.
    :param features: The actor's features, shape (n, features_dim).
    """
    # Behind its own, DPPO has features for networks that are not trained.
    features = features[:, : policy.mlp_extractor.latent_dim_pi]
    outputs: th.Tensor = policy.velocity(drawn.points, drawn.times, features)
    return outputs


def matching_losses(policy: Any, features: th.Tensor, endpoints: th.Tensor) -> th.Tensor:
    """How badly a policy's network leads to end points, shape (n,).

    :param policy: The policy, which draws the points on the way.
    :param features: The actor's features, shape (n, features_dim).
    :param endpoints: Actions before their shape is that of their space, shape (n, action_dim).
    """
    drawn = policy.draw_matching(endpoints)
    error = matched_outputs(policy, drawn, features) - drawn.targets
    losses: th.Tensor = drawn.weights * error.square().sum(dim=-1)
    return losses


class ImitationPull:
    """Pulls a policy towards the one that was cloned from demonstrations.

    coef E ||g (v - v_cloned)||^2    at points on the way from drawn latents to the actions taken

    v is the velocity, and g = 1; of DPPO the network's output, which g turns into what the mean of
    the next step changes by.

    :param policy: The policy that learns.
    :param parameters: Its parameters when it had been cloned, by name.
    :param coef: Weight of the pull at the present progress.
    """

    def __init__(self, policy: Any, parameters: Mapping[str, Any], coef: float) -> None:
        self._policy, self.coef = policy, coef
        self._cloned = deepcopy(policy).requires_grad_(False)
        tensors = {name: th.as_tensor(values) for name, values in parameters.items()}
        self._cloned.load_state_dict(tensors, strict=False)
        self._cloned.set_training_mode(False)

    def loss(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> th.Tensor:
        """The pull before it is multiplied by its weight, a tensor without dimensions.

        :param batch: A minibatch of n samples.
        :param features: The actor's features, shape (n, features_dim).
        """
        drawn = self._policy.draw_matching(batch.actions.flatten(1))
        with th.no_grad():
            cloned_features = self._cloned.actor_features(batch.observations)
            cloned = matched_outputs(self._cloned, drawn, cloned_features)
        change = matched_outputs(self._policy, drawn, features) - cloned
        pull: th.Tensor = (drawn.gains.unsqueeze(-1) * change).square().sum(dim=-1).mean()
        return pull
