"""Policies whose flow is an ordinary differential equation."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_policyflow.common.checks import check_count
from sb3_policyflow.common.policies import FlowActorCriticPolicy
from sb3_policyflow.flows import SOLVERS, Path
from sb3_policyflow.flows.choices import choose
from sb3_policyflow.flows.solvers import solver_times


class OdeFlowPolicy(FlowActorCriticPolicy):
    """An actor-critic policy that carries Gaussian latents along a flow with a fixed-step solver.

    z ~ N(0, I),    dx/dt = v(x, t, s) from x_0 = z to phi = x_T

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowActorCriticPolicy`, and:

    :param flow_path: The interpolation path of the update, whose ``end_time`` T is where the flow
        ends.
    :param n_flow_steps: Solver steps from z to phi.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    """

    own_parameters: ClassVar[tuple[str, ...]] = (
        *FlowActorCriticPolicy.own_parameters,
        "n_flow_steps",
        "solver",
    )

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *args: Any,
        flow_path: Path,
        n_flow_steps: int,
        solver: str,
        **kwargs: Any,
    ) -> None:
        self.path = flow_path
        self.n_flow_steps = n_flow_steps
        self.solver = solver
        choose("solver", solver, SOLVERS)
        check_count("n_flow_steps", n_flow_steps, 1)
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)

    def solver_times(self) -> th.Tensor:
        """The solver's time grid, on the policy's device."""
        times = solver_times(self.solver, self.n_flow_steps, self.path.end_time)
        return times.to(self.velocity.output.weight)

    def carry(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Carry latents along the flow.

        :param latents: z, shape (n, action_dim).
        :param features: The actor's features, shape (n, features_dim).
        :return: phi, shape (n, action_dim).
        """
        return self.velocity.integrate(
            latents,
            features,
            solver=self.solver,
            n_steps=self.n_flow_steps,
            end_time=self.path.end_time,
        )
