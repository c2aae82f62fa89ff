"""Interpolants between a latent and an end point (paper, table of interpolation paths).

An interpolant defines the points x_t between z and phi at which velocities are compared, and how
the score of these points follows from the velocity.
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch as th


class InterpolantCoefficients(NamedTuple):
    """Coefficients of x_t = latent z + endpoint phi + noise h, each of the shape of the times."""

    latent: th.Tensor
    endpoint: th.Tensor
    noise: th.Tensor


class ScoreCoefficients(NamedTuple):
    """Coefficients of score * grad log p_t(x) = velocity * v_t(x) - point * x."""

    score: th.Tensor
    velocity: th.Tensor
    point: th.Tensor


class Interpolant(ABC):
    """How x_t goes from a latent at t = 0 to an end point at t = ``end_time``."""

    end_time: float = 1.0
    stochastic: bool = False

    @abstractmethod
    def coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        """Coefficients of x_t at each time."""

    @abstractmethod
    def derivative_coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        """Coefficients of dx_t/dt at each time."""

    @abstractmethod
    def score_coefficients(self, times: th.Tensor) -> ScoreCoefficients:
        """Coefficients of the relation between score and velocity at each time."""

    def interpolate(
        self,
        latents: th.Tensor,
        endpoints: th.Tensor,
        times: th.Tensor,
        noise: th.Tensor | None = None,
    ) -> th.Tensor:
        """Points x_t on the path.

        :param latents: z, shape (..., dim).
        :param endpoints: phi, shape (..., dim).
        :param times: t, shape (...), which broadcasts with the leading shape of the others.
        :param noise: h ~ N(0, I), for stochastic interpolants, drawn if not given; others ignore
            it.
        :return: x_t, shape (..., dim).
        """
        return self._combine(self.coefficients(times), latents, endpoints, noise)

    def derivative(
        self,
        latents: th.Tensor,
        endpoints: th.Tensor,
        times: th.Tensor,
        noise: th.Tensor | None = None,
    ) -> th.Tensor:
        """Velocity dx_t/dt of the interpolant, the target of flow matching.

        Takes and returns the shapes of :meth:`interpolate`.
        """
        return self._combine(self.derivative_coefficients(times), latents, endpoints, noise)

    def brownian_residual(
        self,
        velocity: th.Tensor,
        reference_velocity: th.Tensor,
        points: th.Tensor,
        times: th.Tensor,
        latent_std: float | th.Tensor = 1.0,
    ) -> th.Tensor:
        """How far a velocity is from minus the score of the reference flow (paper, eta_t).

        eta = c(t) (v + grad log p_t), where the score follows from the reference velocity v_ref:
        eta = c(t) v - (b(t) x_t - a(t) v_ref),    c score = a v_ref - b x_t

        Latents of standard deviation s are the unit of length: the residual is that of x / s and
        v / s, and does not depend on the unit of actions. It is c (v + s^2 score) / s, since for
        interpolants without noise of their own a v_ref - b x_t = c s^2 score: the Brownian motion
        is s times as fast where actions have s times the range.

        >>> t, x, v = th.tensor([0.25]), th.tensor([[2.0]]), th.tensor([[4.0]])
        >>> Rectified().brownian_residual(v, v, x, t).item()  # 0.75 * 4 - (2 - 0.25 * 4)
        2.0

        :param velocity: v, shape (..., dim).
        :param reference_velocity: v_ref, that of the reference policy at the same points,
            shape (..., dim).
        :param points: x_t, shape (..., dim).
        :param times: t, shape (...).
        :param latent_std: s, of z ~ N(0, s^2), a number or shape (dim,); 1 for stochastic
            interpolants.
        :return: eta, shape (..., dim).
        """
        score, velocity_coef, point = (c.unsqueeze(-1) for c in self.score_coefficients(times))
        score_term = point * points - velocity_coef * reference_velocity
        return (score * velocity - score_term) / latent_std

    def _combine(
        self,
        coefficients: InterpolantCoefficients,
        latents: th.Tensor,
        endpoints: th.Tensor,
        noise: th.Tensor | None,
    ) -> th.Tensor:
        latent, endpoint, spread = (c.unsqueeze(-1) for c in coefficients)
        points = latent * latents + endpoint * endpoints
        if not self.stochastic:
            return points
        return points + spread * (th.randn_like(points) if noise is None else noise)


class Rectified(Interpolant):
    """The straight path of rectified flow.

    x_t = (1 - t) z + t phi,    (1 - t) grad log p_t = t v_t - x
    """

    def coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        return InterpolantCoefficients(1 - times, times, th.zeros_like(times))

    def derivative_coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        ones = th.ones_like(times)
        return InterpolantCoefficients(-ones, ones, th.zeros_like(times))

    def score_coefficients(self, times: th.Tensor) -> ScoreCoefficients:
        return ScoreCoefficients(1 - times, times, th.ones_like(times))


class _NoisyLine(Interpolant):
    """A straight path with noise that is greatest in its middle.

    x_t = (1 - t) z + t phi + sqrt(2 t (1 - t)) h
    """

    stochastic = True

    def coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        return InterpolantCoefficients(1 - times, times, (2 * times * (1 - times)).sqrt())

    def derivative_coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        """Coefficients of dx_t/dt; the noise's is infinite at both end points."""
        ones = th.ones_like(times)
        noise = (1 - 2 * times) / (2 * times * (1 - times)).sqrt()
        return InterpolantCoefficients(-ones, ones, noise)


class StochasticInterpolant(_NoisyLine):
    """The paper's stochastic interpolant: x_t = (1 - t) z + t phi + sqrt(2 t (1 - t)) h.

    (2 (t - 1/2)^2 + 1/2) grad log p_t ~ t v_t - x: an approximation (paper, appendix on the
    relation between score and velocity for stochastic interpolants).
    """

    def score_coefficients(self, times: th.Tensor) -> ScoreCoefficients:
        return ScoreCoefficients(2 * (times - 0.5) ** 2 + 0.5, times, th.ones_like(times))


class ExactStochasticInterpolant(_NoisyLine):
    """The stochastic interpolant with the score relation that holds exactly for Gaussian latents.

    Latent and noise together are Gaussian of variance (1 - t)^2 + 2 t (1 - t) = 1 - t^2, so that
    x_t = t phi + sqrt(1 - t^2) e and grad log p_t = t v_t - x, whatever the end points. The paper's
    coefficient is smaller by 2 t (1 - t).
    """

    def score_coefficients(self, times: th.Tensor) -> ScoreCoefficients:
        return ScoreCoefficients(th.ones_like(times), times, th.ones_like(times))


class TrigFlow(Interpolant):
    """The path along a quarter of a circle.

    x_t = cos(t) z + sin(t) phi,    cos(t) grad log p_t = sin(t) v_t - cos(t) x,    0 <= t <= pi/2
    """

    end_time = math.pi / 2

    def coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        return InterpolantCoefficients(times.cos(), times.sin(), th.zeros_like(times))

    def derivative_coefficients(self, times: th.Tensor) -> InterpolantCoefficients:
        return InterpolantCoefficients(-times.sin(), times.cos(), th.zeros_like(times))

    def score_coefficients(self, times: th.Tensor) -> ScoreCoefficients:
        return ScoreCoefficients(times.cos(), times.sin(), times.cos())


INTERPOLANTS: dict[str, type[Interpolant]] = {
    "rectified": Rectified,
    "stochastic": StochasticInterpolant,
    "stochastic_exact": ExactStochasticInterpolant,
    "trigflow": TrigFlow,
}
"""Interpolants by their names."""

Path = Interpolant
"""Deprecated alias of :class:`Interpolant`."""
PATHS = INTERPOLANTS
"""Deprecated alias of :data:`INTERPOLANTS`."""
