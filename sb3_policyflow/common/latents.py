"""From latents to actions: where they are drawn, and which of them is the deterministic action."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim

from sb3_policyflow.flows.modes import candidate_latents, densest_endpoints

LatentsAndEnds = tuple[th.Tensor, th.Tensor | None]


class LatentPolicy(ABC):
    """A policy that draws latents and transports them to actions.

    A subclass adds the flow (:meth:`transport`) and the spread of its latents
    (:attr:`latent_scale`).
    """

    deterministic_action: str
    """"mode", "zero" or "drawn"; see :class:`~sb3_policyflow.common.policies.FlowPolicy`."""
    action_space: spaces.Space[Any]

    @cached_property
    def action_dim(self) -> int:
        """Number of action dimensions, whatever the shape of the Box."""
        return get_action_dim(self.action_space)

    @property
    @abstractmethod
    def latent_scale(self) -> float | th.Tensor:
        """Standard deviation of the latents: a number, or one for each dimension of the action."""

    @abstractmethod
    def transport(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Transport latents to actions, without noise on the way or at the end.

        :param latents: z, shape (n, action_dim).
        :param features: The actor's features, shape (n, features_dim).
        :return: Shape (n, action_dim).
        """

    def draw_latents(self, features: th.Tensor, deterministic: bool) -> LatentsAndEnds:
        """Latents z ~ N(0, latent_scale^2) or the deterministic action's; their ends, if known."""
        scale, choice = self.latent_scale, self.deterministic_action
        if (deterministic and choice == "zero") or (isinstance(scale, float) and scale == 0.0):
            return features.new_zeros(features.shape[0], self.action_dim), None
        if not deterministic or choice == "drawn":
            size = (features.shape[0], self.action_dim)  # len() would fix it when exporting
            return scale * th.randn(size, device=features.device, dtype=features.dtype), None
        if isinstance(scale, float):
            candidates = candidate_latents(self.action_dim, scale).to(features)
        else:
            candidates = scale * candidate_latents(self.action_dim).to(features)
        return self.choose_latents(candidates, features)

    def choose_latents(
        self, candidates: th.Tensor, features: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Of latents (k, action_dim) the one whose end point has the most others around it.

        :param candidates: The latents to choose from.
        :param features: The actor's features, shape (n, features_dim).
        :return: For each row of features the latent, and its end point, each (n, action_dim).
        """
        return densest_endpoints(self.transport, candidates, features)

    def draw_endpoints(
        self, features: th.Tensor, deterministic: bool
    ) -> tuple[th.Tensor, th.Tensor]:
        """Latents, see :meth:`draw_latents`, and their end points, each (n, action_dim)."""
        latents, found = self.draw_latents(features, deterministic)
        return latents, self.transport(latents, features) if found is None else found
