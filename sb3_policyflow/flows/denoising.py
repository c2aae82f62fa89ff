"""Markov chains from noise to data, whose steps are Gaussian around what a network predicts.

Steps are numbered from 0, the noisiest, to K - 1: x_0 ~ N(0, I), and x_K is the data.
"""

import math
from abc import abstractmethod

import torch as th
from torch import nn

from sb3_policyflow.flows.interpolants import Rectified
from sb3_policyflow.flows.matching import MatchingSamples

Steps = int | slice
"""One step, or several along the last but one axis of the points."""


class DenoisingProcess(nn.Module):
    """A chain x_{k+1} ~ N(m_k(x_k), s_k^2 I) for k = 0 ... K - 1.

    ``times`` (K,) are the network's time inputs, 0 at the noise and below 1; ``stds`` (K,) are s_k.
    """

    times: th.Tensor
    stds: th.Tensor

    def __init__(self, n_steps: int) -> None:
        super().__init__()
        if n_steps < 1:
            raise ValueError(f"A chain needs at least one step, got n_denoising_steps={n_steps}.")
        self.n_steps = n_steps
        self._keep("times", th.arange(n_steps, dtype=th.float64) / n_steps)

    def _keep(self, name: str, values: th.Tensor) -> None:
        """Remember constants that move with the module but are not saved."""
        self.register_buffer(name, values.to(th.get_default_dtype()), persistent=False)

    @abstractmethod
    def means(self, points: th.Tensor, outputs: th.Tensor, steps: Steps) -> th.Tensor:
        """Means m_k of the next points.

        :param points: x_k, shape (..., dim), or (..., n_steps, dim) for several steps.
        :param outputs: What the network says of them at ``times[steps]``, of the same shape.
        :param steps: k.
        :return: m_k, of the same shape.
        """

    @abstractmethod
    def draw_matching(self, data: th.Tensor) -> MatchingSamples:
        """Draw a step for each of some data, a point where it starts, and what is wanted there.

        :param data: x_K, shape (n, dim).
        """

    def _draw_steps(self, data: th.Tensor) -> th.Tensor:
        return th.randint(self.n_steps, (len(data),), device=data.device)


class DDPM(DenoisingProcess):
    """Ho et al. (2020) with the cosine schedule of Nichol and Dhariwal (2021).

    data = (x_k - sqrt(1 - abar_k) eps) / sqrt(abar_k), clamped,    and m_k, s_k the mean and the
    standard deviation of q(x_{k+1} | x_k, data), with eps the network's output (plus x_k).

    >>> [round(std, 3) for std in DDPM(4).stds.tolist()]  # the last step adds no noise
    [0.925, 0.647, 0.355, 0.0]

    :param n_steps: K.
    :param data_clip: The data are taken to lie in [-data_clip, data_clip].
    :param identity_skip: Whether eps = x_k + output, so that a network of zeros predicts data
        around 0, where any other untrained one predicts data beyond the clip.
    """

    def __init__(self, n_steps: int, data_clip: float = 1.0, identity_skip: bool = True) -> None:
        super().__init__(n_steps)
        self.data_clip = data_clip
        self.identity_skip = identity_skip
        alpha_bar = cosine_alpha_bar(n_steps)
        before, after = alpha_bar[:-1], alpha_bar[1:]  # of x_k, and of the less noisy x_{k+1}
        alpha = before / after
        self._keep("stds", ((1 - alpha) * (1 - after) / (1 - before)).sqrt())
        self._keep("_point_to_data", before.rsqrt())
        self._keep("_noise_to_data", (1 / before - 1).sqrt())
        self._keep("_data_to_mean", (1 - alpha) * after.sqrt() / (1 - before))
        self._keep("_point_to_mean", (1 - after) * alpha.sqrt() / (1 - before))

    def means(self, points: th.Tensor, outputs: th.Tensor, steps: Steps) -> th.Tensor:
        """The posterior means of the next points, see :meth:`DenoisingProcess.means`."""
        noise = outputs + points if self.identity_skip else outputs
        data = (
            self._at("_point_to_data", steps) * points - self._at("_noise_to_data", steps) * noise
        )
        data = data.clamp(-self.data_clip, self.data_clip)
        return self._at("_data_to_mean", steps) * data + self._at("_point_to_mean", steps) * points

    def draw_matching(self, data: th.Tensor) -> MatchingSamples:
        """Noisy data x_k = sqrt(abar_k) data + sqrt(1 - abar_k) eps; the network is to say eps."""
        steps, noise = self._draw_steps(data), th.randn_like(data)
        to_data = self._at("_noise_to_data", steps)
        points = (data + to_data * noise) / self._at("_point_to_data", steps)
        targets = noise - points if self.identity_skip else noise
        times = self.times[steps]
        # K steps of a velocity v move a point by v; a change of eps moves K means.
        gains = self.n_steps * (self._at("_data_to_mean", steps) * to_data).squeeze(-1)
        return MatchingSamples(times, points, targets, th.ones_like(times), gains)

    def _at(self, name: str, steps: Steps | th.Tensor) -> th.Tensor:
        coefficients: th.Tensor = getattr(self, name)
        return coefficients[steps].unsqueeze(-1)


class EulerChain(DenoisingProcess):
    """Euler steps of a flow, for noise of a fixed standard deviation around each.

    m_k = x_k + v_k / K,    s_k = 0: the policy's least standard deviation is all the noise
    """

    def __init__(self, n_steps: int) -> None:
        super().__init__(n_steps)
        self._keep("stds", th.zeros(n_steps))

    def means(self, points: th.Tensor, outputs: th.Tensor, steps: Steps) -> th.Tensor:  # noqa: ARG002
        """One Euler step from each point, see :meth:`DenoisingProcess.means`."""
        return points + outputs / self.n_steps

    def draw_matching(self, data: th.Tensor) -> MatchingSamples:
        """Flow matching along straight lines, at the times at which steps start."""
        times, noise = self.times[self._draw_steps(data)], th.randn_like(data)
        points = Rectified().interpolate(noise, data, times)
        ones = th.ones_like(times)
        return MatchingSamples(times, points, data - noise, ones, ones)


def cosine_alpha_bar(n_steps: int, offset: float = 0.008, largest_beta: float = 0.999) -> th.Tensor:
    """The cosine schedule's alpha-bar, the product of all 1 - beta, from x_0 to x_K.

    alpha-bar falls as cos^2(pi / 2 (u + offset) / (1 + offset)) with the noise level u from 0 to 1;
    each step's factor 1 - beta is at least 1 - largest_beta (Nichol and Dhariwal, 2021).

    >>> [round(value, 5) for value in cosine_alpha_bar(2).tolist()]
    [0.00049, 0.49384, 1.0]

    :return: Shape (n_steps + 1,), float64; the last one, that of the data, is 1.
    """
    levels = th.linspace(0, 1, n_steps + 1, dtype=th.float64)
    wanted = (0.5 * math.pi * (levels + offset) / (1 + offset)).cos().square()
    factors = (wanted[1:] / wanted[:-1]).clamp(min=1 - largest_beta)
    return th.cat([th.ones(1, dtype=th.float64), factors.cumprod(0)]).flip(0)
