"""Flow matching: where a velocity is compared on the way to given data, and with what."""

from typing import NamedTuple

import torch as th

from sb3_policyflow.flows.interpolants import Interpolant

EDGE = 1e-4
"""Part of the time at both ends that stochastic interpolants leave out: their noise has an infinite
derivative there."""


class MatchingSamples(NamedTuple):
    """Where a network is trained to point to data, one draw for each of n of them.

    Times t (n,), points x_t (n, dim), and the outputs that are wanted there (n, dim). ``weights``
    (n,) are those of the squared errors. ``gains`` (n,) say by how much the policy's next step
    changes with the network's output, as a velocity: 1 if the output is one.
    """

    times: th.Tensor
    points: th.Tensor
    targets: th.Tensor
    weights: th.Tensor
    gains: th.Tensor


def draw_matching(
    interpolant: Interpolant, endpoints: th.Tensor, latent_std: float | th.Tensor = 1.0
) -> MatchingSamples:
    """Draw latents and times, and what conditional flow matching makes of them.

    x_t between z ~ N(0, latent_std^2) and phi at t ~ U(0, T),    target dx_t/dt

    The minimum of the squared error is the mean of the target given x_t, whose flow carries the
    latents to the distribution of the end points (Lipman et al., 2023). It is the same for every
    weight that depends on t alone: stochastic interpolants have one that keeps the noise's
    derivative bounded, others have 1.

    >>> from sb3_policyflow.flows import Rectified
    >>> drawn = draw_matching(Rectified(), th.zeros(5, 2))
    >>> bool(th.allclose(drawn.points, -(1 - drawn.times[:, None]) * drawn.targets))
    True

    :param interpolant: The path from latents to end points.
    :param endpoints: phi, shape (n, dim).
    :param latent_std: Standard deviation of the latents: a number, or one for each dimension.
    """
    latents = latent_std * th.randn_like(endpoints)
    times = th.rand(len(endpoints), device=endpoints.device, dtype=endpoints.dtype)
    ones = th.ones_like(times)
    if not interpolant.stochastic:
        times = interpolant.end_time * times
        points = interpolant.interpolate(latents, endpoints, times)
        targets = interpolant.derivative(latents, endpoints, times)
        return MatchingSamples(times, points, targets, ones, ones)
    times = interpolant.end_time * times.clamp(EDGE, 1 - EDGE)
    noise = th.randn_like(endpoints)
    points = interpolant.interpolate(latents, endpoints, times, noise)
    targets = interpolant.derivative(latents, endpoints, times, noise)
    spread = interpolant.derivative_coefficients(times).noise
    return MatchingSamples(times, points, targets, 1 / (1 + spread.square()), ones)
