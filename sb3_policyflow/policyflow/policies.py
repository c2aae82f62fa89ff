"""Policies of PolicyFlow: an action is the end of a flow plus Gaussian noise."""

from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import Schedule

from sb3_policyflow.common.policies import FlowActorCriticPolicy
from sb3_policyflow.flows import PATHS, SOLVERS, integrate
from sb3_policyflow.flows.choices import choose
from sb3_policyflow.flows.solvers import solver_times


class PolicyFlowRecord(NamedTuple):
    """How an action was made: latents z and end points phi, each of shape (n, action_dim)."""

    latents: th.Tensor
    endpoints: th.Tensor


class FlowPolicy(FlowActorCriticPolicy):
    """Actor-critic policy that carries Gaussian latents along a flow (paper, policy of PolicyFlow).

    z ~ N(0, I),    dx/dt = v(x, t, s) from x_0 = z to phi = x_T,    a = phi + n,  n ~ N(0, sigma^2)

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowActorCriticPolicy`, and:

    :param path: "rectified", "stochastic", "stochastic_exact" or "trigflow": the interpolation
        path of the update, whose ``end_time`` T is where the flow ends.
    :param n_flow_steps: Solver steps from z to phi.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *args: Any,
        path: str = "rectified",
        n_flow_steps: int = 12,
        solver: str = "midpoint",
        **kwargs: Any,
    ) -> None:
        self.path_name = path
        self.path = choose("path", path, PATHS)()
        self.n_flow_steps = n_flow_steps
        self.solver = solver
        choose("solver", solver, SOLVERS)
        solver_times(solver, n_flow_steps)
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        flow = {"path": self.path_name, "n_flow_steps": self.n_flow_steps, "solver": self.solver}
        return {**super()._get_constructor_parameters(), **flow}

    def solver_times(self) -> th.Tensor:
        """The solver's time grid, on the policy's device."""
        times = solver_times(self.solver, self.n_flow_steps, self.path.end_time)
        return times.to(self.log_std)

    def carry(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Carry latents along the flow.

        :param latents: z, shape (n, action_dim).
        :param features: The actor's features, shape (n, features_dim).
        :return: phi, shape (n, action_dim).
        """
        return integrate(
            lambda points, time: self.velocity(points, time, features),
            latents,
            n_steps=self.n_flow_steps,
            solver=self.solver,
            end_time=self.path.end_time,
        )

    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, PolicyFlowRecord]:
        """Draw actions; the deterministic one has z = 0 and n = 0."""
        size = (2, len(features), self.action_dim)
        draws = th.zeros if deterministic else th.randn
        latents, noise = draws(size, device=features.device, dtype=self.log_std.dtype)
        endpoints = self.carry(latents, features)
        actions = endpoints + noise * self.noise_log_std.exp()
        return actions, PolicyFlowRecord(latents, endpoints)


MlpFlowPolicy = FlowPolicy


class CnnFlowPolicy(FlowPolicy):
    """:class:`FlowPolicy` for images: its default features extractor is SB3's ``NatureCNN``."""

    def __init__(
        self,
        *args: Any,
        features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class MultiInputFlowPolicy(FlowPolicy):
    """:class:`FlowPolicy` for Dict observations, by default with SB3's ``CombinedExtractor``."""

    def __init__(
        self,
        *args: Any,
        features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)
