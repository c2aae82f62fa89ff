"""The flow of a policy: a velocity field, an interpolant and a solver as one object."""

from typing import NamedTuple, TypedDict

import torch as th

from sb3_policyflow.flows.interpolants import Interpolant
from sb3_policyflow.flows.solvers import SOLVERS, solver_times_like
from sb3_policyflow.flows.velocity import VelocityField


class _Method(TypedDict):
    solver: str
    n_steps: int
    end_time: float


class Flow(NamedTuple):
    """A continuous normalizing flow (paper, flow ODE).

    phi = z + int_0^T v(x_t, t, s) dt,    x_0 = z

    >>> from sb3_policyflow.flows import Rectified
    >>> flow = Flow(VelocityField(2, 3), Rectified(), solver="midpoint", n_steps=4)
    >>> flow.solve(th.zeros(5, 2), th.zeros(5, 3)).shape, flow.n_evaluations
    (torch.Size([5, 2]), 8)

    :param velocity: The field v.
    :param interpolant: The points between latents and end points at which an update compares
        velocities; its ``end_time`` T is where the flow ends.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param n_steps: Solver steps from latent to end point.
    """

    velocity: VelocityField
    interpolant: Interpolant
    solver: str
    n_steps: int

    def solve(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """End points of the flow.

        :param latents: z, shape (n, dim).
        :param features: s, shape (n, features_dim).
        :return: phi, shape (n, dim).
        """
        return self.velocity.integrate(latents, features, **self._method())

    def choose_latents(
        self, candidates: th.Tensor, features: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Of some latents, the one whose end point has the most others around it.

        :param candidates: The latents to choose from, shape (k, dim).
        :param features: s, shape (n, features_dim).
        :return: For each row of features the latent, and its end point, each of shape (n, dim).
        """
        return self.velocity.choose_latents(candidates, features, **self._method())

    def _method(self) -> _Method:
        return {
            "solver": self.solver,
            "n_steps": self.n_steps,
            "end_time": self.interpolant.end_time,
        }

    def times(self) -> th.Tensor:
        """The solver's time grid on the device of the field (paper: the discrete time grid)."""
        like = self.velocity.time_embedding.frequencies
        return solver_times_like(like, self.solver, self.n_steps, self.interpolant.end_time)

    @property
    def n_evaluations(self) -> int:
        """Evaluations of the velocity for one end point."""
        return self.n_steps * SOLVERS[self.solver].n_stages
