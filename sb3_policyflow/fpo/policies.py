"""Policies of FPO: an action is the end of a flow."""

from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_policyflow.common.aliases import DictFeatures, ImageFeatures
from sb3_policyflow.common.checks import check_between
from sb3_policyflow.common.ode_policy import OdeFlowPolicy
from sb3_policyflow.flows import Rectified


class NoRecord(NamedTuple):
    """FPO asks nothing of how an action was made: it looks at the action alone."""


class FPOPolicy(OdeFlowPolicy):
    """Actor-critic policy that carries Gaussian latents along a flow to the action.

    z ~ N(0, I),    dx/dt = v(x, t, s) from x_0 = z to a = x_1

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowActorCriticPolicy`, and:

    :param n_flow_steps: Solver steps from z to the action.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param action_noise_std: Standard deviation of Gaussian noise on top of the flow's end.
    """

    own_parameters: ClassVar[tuple[str, ...]] = (*OdeFlowPolicy.own_parameters, "action_noise_std")

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
        check_between("action_noise_std", action_noise_std, 0.0)
        self.action_noise_std = action_noise_std
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            *args,
            flow_path=Rectified(),
            n_flow_steps=n_flow_steps,
            solver=solver,
            **kwargs,
        )

    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, NoRecord]:
        """Draw actions; the deterministic one has z = 0 and no noise (FPO++: zero-sampling)."""
        actions = self.carry(self.draw_latents(features, deterministic), features)
        if self.action_noise_std > 0 and not deterministic:
            actions = actions + self.action_noise_std * th.randn_like(actions)
        return actions, NoRecord()


MlpFlowPolicy = FPOPolicy


class CnnFlowPolicy(ImageFeatures, FPOPolicy):
    """:class:`FPOPolicy` for images: its default features extractor is SB3's ``NatureCNN``."""


class MultiInputFlowPolicy(DictFeatures, FPOPolicy):
    """:class:`FPOPolicy` for Dict observations, by default with SB3's ``CombinedExtractor``."""
