"""The velocity field v(x, t, s) of a flow policy (paper, Model Architecture)."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from numbers import Integral
from typing import Any, ClassVar

import numpy as np
import torch as th
from torch import nn

from sb3_policyflow.flows.choices import choose
from sb3_policyflow.flows.folding import integrate_folded, is_foldable
from sb3_policyflow.flows.modes import densest_endpoints
from sb3_policyflow.flows.solvers import integrate


class FourierTimeEmbedding(nn.Module):
    """An MLP over cosines and sines of fixed frequencies.

    t_emb = MLP([cos(2 pi f_i t), sin(2 pi f_i t)])    (paper, Model Architecture)

    >>> FourierTimeEmbedding(8)(th.rand(5, 3)).shape
    torch.Size([5, 3, 8])

    :param embedding_dim: Size of the embedding.
    :param frequencies: The frequencies f_i in turns per unit of time, or how many to draw from
        ``N(0, frequency_scale^2)``; half the embedding's size if not given.
    :param frequency_scale: Standard deviation of the frequencies that are drawn.
    :param activation_fn: Activation of the MLP.
    :raises ValueError: If there are no frequencies.
    """

    frequencies: nn.Parameter
    """Shape (n_frequencies,). A parameter, as those that are drawn are part of what makes the
    policy, but one that is never learned."""

    def __init__(
        self,
        embedding_dim: int,
        frequencies: int | Sequence[float] | None = None,
        frequency_scale: float = 1.0,
        activation_fn: type[nn.Module] = nn.Mish,
    ) -> None:
        super().__init__()
        if frequencies is None:
            frequencies = max(embedding_dim // 2, 1)
        values = _given_or_drawn(frequencies, frequency_scale)
        self.frequencies = nn.Parameter(values, requires_grad=False)
        self.mlp = nn.Sequential(
            nn.Linear(2 * len(values), embedding_dim),
            activation_fn(),
            nn.Linear(embedding_dim, embedding_dim),
        )

    def forward(self, times: th.Tensor) -> th.Tensor:
        """Embed times of shape (...) into shape (..., embedding_dim)."""
        inputs = fourier_features(times, self.frequencies.detach())
        # Other linear layers than torch's, such as quantized ones, take nothing but rows.
        embedding: th.Tensor = self.mlp(inputs if times.dim() > 0 else inputs.unsqueeze(0))
        return embedding.view(*times.shape, embedding.shape[-1])


def fourier_features(times: th.Tensor, frequencies: th.Tensor) -> th.Tensor:
    """Cosines and sines of times of shape (...), shape (..., 2 n_frequencies)."""
    phases = 2 * math.pi * times.unsqueeze(-1) * frequencies
    return th.cat([phases.cos(), phases.sin()], dim=-1)


def _given_or_drawn(frequencies: object, scale: float) -> th.Tensor:
    if isinstance(frequencies, Integral) and int(frequencies) >= 1:
        return scale * th.randn(int(frequencies))
    values = th.as_tensor(frequencies, dtype=th.get_default_dtype())
    if values.dim() != 1 or len(values) == 0:
        raise ValueError(
            f"frequencies must be a list of numbers, or how many to draw, got {frequencies!r}."
        )
    return values


class VelocityField(nn.Module):
    """A velocity conditioned on time and observation features.

    v(x, t, s) = MLP([x, t_emb(t) + W s])    (paper, Model Architecture)

    >>> field = VelocityField(2, 3, net_arch=[16])
    >>> field(th.randn(7, 2), th.rand(7), th.randn(7, 3)).shape
    torch.Size([7, 2])

    :param dim: Dimensions of the points, those of the action.
    :param features_dim: Dimensions of the observation's features.
    :param net_arch: Hidden layers of the MLP.
    :param activation_fn: Activation of both MLPs.
    :param embedding_dim: Size of the time and observation embeddings.
    :param frequencies: See :class:`FourierTimeEmbedding`.
    :param frequency_scale: See :class:`FourierTimeEmbedding`.
    :param initialization: "orthogonal", whose layers keep variances, or one of the paper's,
        "glorot", "glorot_zero_output" and "zero" (paper, sensitivity to network initialization).
        The velocity is zero at the start but for "glorot". With "zero" only the output's bias ever
        learns if the activation of 0 is 0.
    :raises ValueError: If the initialization is unknown or the embedding is empty.
    """

    has_formula_of_paper: ClassVar[bool] = True
    """Whether :meth:`forward` is the formula above, so that its first layer may be split."""

    def __init_subclass__(cls, has_formula_of_paper: bool = False) -> None:
        # A subclass may have any velocity: that it has the paper's, it must say itself.
        super().__init_subclass__()
        cls.has_formula_of_paper = has_formula_of_paper

    def __init__(
        self,
        dim: int,
        features_dim: int,
        net_arch: Sequence[int] = (64, 64),
        activation_fn: type[nn.Module] = nn.Mish,
        embedding_dim: int = 64,
        frequencies: int | Sequence[float] | None = None,
        frequency_scale: float = 1.0,
        initialization: str = "orthogonal",
    ) -> None:
        super().__init__()
        if embedding_dim < 1:
            raise ValueError(f"embedding_dim must be at least 1, got {embedding_dim}.")
        initialize = choose("initialization", initialization, INITIALIZATIONS)
        self.time_embedding = FourierTimeEmbedding(
            embedding_dim, frequencies, frequency_scale, activation_fn
        )
        self.observation_embedding = nn.Linear(features_dim, embedding_dim)
        self.hidden = _hidden_layers(dim + embedding_dim, net_arch, activation_fn)
        self.output = nn.Linear([dim + embedding_dim, *net_arch][-1], dim)
        initialize(self)

    @property
    def layers(self) -> list[nn.Module]:
        """What the MLP consists of: linear layers with activations between them."""
        return [*self.hidden, self.output]

    def forward(self, points: th.Tensor, times: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Velocity at points, times and features, whose leading shapes broadcast.

        :param points: x, shape (..., dim).
        :param times: t, shape (...).
        :param features: s, shape (..., features_dim).
        :return: v, shape (..., dim).
        """
        embedding = self.time_embedding(times) + self.observation_embedding(features)
        embedding = embedding.expand(*points.shape[:-1], embedding.shape[-1])
        velocity: th.Tensor = self.output(self.hidden(th.cat([points, embedding], dim=-1)))
        return velocity

    def integrate(
        self,
        latents: th.Tensor,
        features: th.Tensor,
        *,
        solver: str,
        n_steps: int,
        end_time: float = 1.0,
    ) -> th.Tensor:
        """Carry latents along the flow to its end points (paper, flow ODE).

        The first layer is split where it is plainly linear, see :mod:`~.folding`.

        >>> field, z, s = VelocityField(2, 3, [16]), th.randn(5, 2), th.randn(5, 3)
        >>> field.integrate(z, s, solver="midpoint", n_steps=12).shape
        torch.Size([5, 2])

        :param latents: z, where the flow starts, shape (..., dim).
        :param features: s, of a leading shape that broadcasts, shape (..., features_dim).
        :param solver: Name of the solver, see :func:`~.solvers.integrate`.
        :param n_steps: Number of equal steps, at least 1.
        :param end_time: T, where the flow ends.
        :return: phi, the end points, of the shape of ``latents``.
        :raises ValueError: If the solver is unknown or ``n_steps`` is less than 1.
        """
        if is_foldable(self):
            return integrate_folded(
                self, latents, features, n_steps=n_steps, solver=solver, end_time=end_time
            )
        return integrate(
            lambda points, time: self(points, time, features),
            latents,
            n_steps=n_steps,
            solver=solver,
            end_time=end_time,
        )

    def choose_latents(
        self,
        candidates: th.Tensor,
        features: th.Tensor,
        *,
        solver: str,
        n_steps: int,
        end_time: float = 1.0,
    ) -> tuple[th.Tensor, th.Tensor]:
        """Of some latents, the one whose end point has the most others around it.

        >>> field, latents, s = VelocityField(2, 3, [16]), th.randn(16, 2), th.randn(5, 3)
        >>> chosen, ends = field.choose_latents(latents, s, solver="midpoint", n_steps=4)
        >>> chosen.shape, ends.shape
        (torch.Size([5, 2]), torch.Size([5, 2]))

        :param candidates: The latents to choose from, shape (k, dim).
        :param features: s, shape (n, features_dim).
        :param solver: As for :meth:`integrate`, and so are the others.
        :return: For each row of features the latent, and its end point, each of shape (n, dim).
        """
        carry = partial(self.integrate, solver=solver, n_steps=n_steps, end_time=end_time)
        return densest_endpoints(carry, candidates, features)


def _hidden_layers(
    input_dim: int, net_arch: Sequence[int], activation_fn: type[nn.Module]
) -> nn.Sequential:
    sizes = [input_dim, *net_arch]
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), activation_fn()]
    return nn.Sequential(*layers)


def _glorot(field: VelocityField) -> None:
    """Glorot weights and zero biases (paper: GI)."""
    for layer in field.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_normal_(layer.weight)
            nn.init.zeros_(layer.bias)


def _glorot_zero_output(field: VelocityField) -> None:
    """Glorot weights and an output layer of zeros (paper: GI+ZOL)."""
    _glorot(field)
    nn.init.zeros_(field.output.weight)


def _zero(field: VelocityField) -> None:
    """Zero everywhere (paper: ZI)."""
    for parameter in field.parameters():
        if parameter is not field.time_embedding.frequencies:
            nn.init.zeros_(parameter)


def _orthogonal(field: VelocityField) -> None:
    """Orthogonal layers that keep variances, and an output layer of zeros.

    Observations of variance 1 are embedded with variance 1, whatever their number, and every hidden
    layer keeps the variance under the activation that there is. Time enters with less, so that the
    velocity begins as a function of the observation rather than of random features of time.
    """
    time_hidden, activation, time_output = field.time_embedding.mlp
    _fill_orthogonal(time_hidden, 2**0.5)  # cosines and sines have a mean square of 1/2
    _fill_orthogonal(time_output, TIME_STD * _gain(activation))
    _fill_orthogonal(field.observation_embedding, 1.0)
    gain = 1.0
    for layer in field.hidden:
        if isinstance(layer, nn.Linear):
            _fill_orthogonal(layer, gain)
        else:
            gain = _gain(layer)
    nn.init.zeros_(field.output.weight)
    nn.init.zeros_(field.output.bias)


TIME_STD = 0.3
"""Standard deviation of the time embedding where that of the observation embedding is 1."""


def _fill_orthogonal(layer: Any, gain: float) -> None:
    """A linear layer with orthogonal weights, which multiply the standard deviation by a gain."""
    n_out, n_in = layer.weight.shape
    nn.init.orthogonal_(layer.weight, gain * max(1.0, n_out / n_in) ** 0.5)
    nn.init.zeros_(layer.bias)


def _gain(activation: nn.Module) -> float:
    """1 / sqrt(E[f(x)^2]) for x ~ N(0, 1), which keeps the variance behind an activation f.

    >>> round(_gain(nn.ReLU()), 6), round(_gain(nn.Identity()), 6)
    (1.414214, 1.0)
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    with th.no_grad():
        values = activation(th.as_tensor(nodes, dtype=th.float32, device="cpu")).double().numpy()
    mean_square = float((weights * values**2).sum() / weights.sum())
    return 1 / math.sqrt(mean_square)


INITIALIZATIONS: dict[str, Callable[[VelocityField], None]] = {
    "orthogonal": _orthogonal,
    "glorot": _glorot,
    "glorot_zero_output": _glorot_zero_output,
    "zero": _zero,
}
