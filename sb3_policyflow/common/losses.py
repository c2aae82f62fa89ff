"""The terms of the objective as pure functions of tensors."""

import math

import torch as th


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
    new = _gaussian_energy(noise - shift, log_std)
    old = _gaussian_energy(noise, old_log_std)
    return (old - new).sum(dim=-1)


def _gaussian_energy(deviation: th.Tensor, log_std: th.Tensor) -> th.Tensor:
    """-log N(deviation; 0, sigma^2) without its constant, per dimension."""
    return 0.5 * (deviation / log_std.exp()) ** 2 + log_std


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
    """Entropy of the Gaussian noise (paper, second term of the entropy regulariser).

    1/2 sum_i log(2 pi e sigma_i^2)

    :param log_std: log sigma, shape (action_dim,).
    :return: The entropy in nats, a tensor without dimensions.
    """
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()


def clipped_surrogate(log_ratio: th.Tensor, advantages: th.Tensor, clip_range: float) -> th.Tensor:
    """PPO's clipped objective for each sample, to be maximised (paper, J^Flow).

    min(rho A, clip(rho, 1 - epsilon, 1 + epsilon) A)

    >>> clipped_surrogate(th.tensor([1.0, -1.0]), th.tensor([1.0, 1.0]), 0.5)
    tensor([1.5000, 0.3679])

    :param log_ratio: log rho, shape (...).
    :param advantages: A, a shape that broadcasts with it.
    :param clip_range: epsilon.
    :return: The objective, shape (...).
    """
    ratio = log_ratio.exp()
    clipped = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
    return th.min(ratio * advantages, clipped * advantages)
