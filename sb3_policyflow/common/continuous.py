"""Policies whose flow is that of a differential equation: what PolicyFlow's and FPO's share."""

from abc import abstractmethod

import torch as th

from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.flows import Flow, MatchingSamples, VelocityField, draw_matching


class ContinuousFlowPolicy(FlowPolicy):
    """A flow policy whose end points are those of a differential equation, of its velocity field.

    Takes the arguments of :class:`FlowPolicy`.
    """

    def _build_actor(self) -> None:
        self.velocity = self._make_velocity_field()

    @property
    @abstractmethod
    def flow(self) -> Flow:
        """The flow from latents to end points."""

    @property
    def n_evaluations_per_action(self) -> int:
        return self.flow.n_evaluations

    def transport(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """End points of the flow, see :meth:`LatentPolicy.transport`."""
        return self.flow.solve(latents, features)

    def choose_latents(
        self, candidates: th.Tensor, features: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """As in the base class."""
        flow, carry = self.flow, getattr(self.transport, "__func__", None)
        is_plain = type(flow) is Flow and isinstance(flow.velocity, VelocityField)
        if is_plain and carry is ContinuousFlowPolicy.transport:
            return flow.choose_latents(candidates, features)  # in one call, where kernels can
        return super().choose_latents(candidates, features)

    def draw_matching(self, endpoints: th.Tensor) -> MatchingSamples:
        """Draw where flow matching compares the velocity on the way to end points (n, dim)."""
        return draw_matching(self.flow.interpolant, endpoints, self.latent_scale)
