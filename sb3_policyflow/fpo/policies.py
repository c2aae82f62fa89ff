"""Policies of FPO: an action is the end point of a flow."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import Schedule

from sb3_policyflow.common import checks
from sb3_policyflow.common.continuous import ContinuousFlowPolicy
from sb3_policyflow.common.options import FlowOptions
from sb3_policyflow.flows import SOLVERS, Flow, Rectified


class FPOOptions(FlowOptions, total=False):
    """The shared options, and those of the policy."""

    n_flow_steps: int
    solver: str
    action_noise_std: float


class NoRecord(NamedTuple):
    """FPO needs no record of how an action was made: its update looks at the action alone."""


class FPOPolicy(ContinuousFlowPolicy):
    """Actor-critic policy that transports Gaussian latents along a flow to the action.

    z ~ N(0, I),    dx/dt = v(x, t, s) from x_0 = z to a = x_1

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowPolicy`, and:

    :param n_flow_steps: Solver steps from z to the action.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param action_noise_std: Standard deviation of Gaussian noise on top of the flow's end point.
    :raises ValueError: If an option is not supported.
    """

    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "n_flow_steps": checks.at_least(1),
        "solver": checks.one_of(SOLVERS),
        "action_noise_std": checks.between(0.0),
    }

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *args: Any,
        n_flow_steps: int = 10,
        solver: str = "euler",
        action_noise_std: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.n_flow_steps = n_flow_steps
        self.solver = solver
        self.action_noise_std = action_noise_std
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)

    @property
    def flow(self) -> Flow:
        """The flow from latents to actions."""
        return Flow(self.velocity, Rectified(), self.solver, self.n_flow_steps)

    @property
    def latent_scale(self) -> float:
        return 1.0

    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, NoRecord]:
        """Draw actions; deterministic ones have no noise (FPO++: with "zero", zero-sampling)."""
        _, actions = self.draw_endpoints(features, deterministic)
        if self.action_noise_std > 0 and not deterministic:
            actions = actions + self.action_noise_std * th.randn_like(actions)
        return actions, NoRecord()


MlpFlowPolicy = FPOPolicy


class CnnFlowPolicy(FPOPolicy):
    """:class:`FPOPolicy` for images: its default features extractor is ``NatureCNN``."""

    default_features_extractor_class = NatureCNN


class MultiInputFlowPolicy(FPOPolicy):
    """:class:`FPOPolicy` for Dict observations, by default with ``CombinedExtractor``."""

    default_features_extractor_class = CombinedExtractor
