"""Policies of PolicyFlow: an action is the end of a flow plus Gaussian noise."""

from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_policyflow.common.aliases import DictFeatures, ImageFeatures
from sb3_policyflow.common.checks import check_bounds, check_number, check_positive
from sb3_policyflow.common.ode_policy import OdeFlowPolicy
from sb3_policyflow.flows import PATHS
from sb3_policyflow.flows.choices import choose


class PolicyFlowRecord(NamedTuple):
    """How an action was made: latents z and end points phi, each of shape (n, action_dim)."""

    latents: th.Tensor
    endpoints: th.Tensor


class FlowPolicy(OdeFlowPolicy):
    """Actor-critic policy that carries Gaussian latents along a flow (paper, policy of PolicyFlow).

    z ~ N(0, I),    dx/dt = v(x, t, s) from x_0 = z to phi = x_T,    a = phi + n,  n ~ N(0, sigma^2)

    ``latent_std`` is not of the paper, whose latents are of standard deviation 1. What they add to
    an action is noise that the importance ratio does not see, and where actions are bounded by 1 it
    drowns sigma. With less of it locomotion is learned faster, HalfCheetah several times as fast;
    tasks whose rewards have to be found first are learned less well (docs/results.md).

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowActorCriticPolicy`, and:

    :param log_std_init: Initial log standard deviation of the Gaussian noise.
    :param log_std_bounds: Lowest and highest log standard deviation of the noise; None for none.
    :param latent_std: Standard deviation of the latents z, greater than 0. Other than 1 it needs a
        path without noise of its own, "rectified" or "trigflow".
    :param path: "rectified", "stochastic", "stochastic_exact" or "trigflow": the interpolation
        path of the update, whose ``end_time`` T is where the flow ends.
    :param n_flow_steps: Solver steps from z to phi.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param gaussian: Whether z is always 0, which leaves a Gaussian policy with mean phi.
    """

    own_parameters: ClassVar[tuple[str, ...]] = (
        *OdeFlowPolicy.own_parameters,
        "log_std_init",
        "log_std_bounds",
        "latent_std",
        "gaussian",
    )

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *args: Any,
        log_std_init: float = 0.0,
        log_std_bounds: tuple[float, float] | None = None,
        latent_std: float = 1.0,
        path: str = "rectified",
        n_flow_steps: int = 12,
        solver: str = "midpoint",
        gaussian: bool = False,
        **kwargs: Any,
    ) -> None:
        check_number("log_std_init", log_std_init)
        if log_std_bounds is not None:
            check_bounds("log_std_bounds", log_std_bounds)
        self.log_std_bounds = log_std_bounds
        self.latent_std = latent_std
        self.path_name = path
        self.gaussian = gaussian
        self._check_latents()
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            *args,
            flow_path=choose("path", path, PATHS)(),
            n_flow_steps=n_flow_steps,
            solver=solver,
            **kwargs,
        )
        # SB3 has set both to the defaults of its own actor.
        self.log_std_init = log_std_init
        nn.init.constant_(self.log_std, log_std_init)
        self.keep_within_bounds()

    def _check_latents(self) -> None:
        check_positive("latent_std", self.latent_std)
        if self.latent_std == 1.0:
            return
        if self.gaussian:
            raise ValueError("With gaussian=True latents are 0: leave out latent_std.")
        if choose("path", self.path_name, PATHS).stochastic:
            raise ValueError(
                f"With path={self.path_name!r} the latents' standard deviation is 1: leave out "
                "latent_std, or use path='rectified' or path='trigflow'."
            )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "path": self.path_name}

    def _build_actor(self) -> None:
        super()._build_actor()
        self.log_std = nn.Parameter(th.zeros(self.action_dim))

    @property
    def noise_log_std(self) -> th.Tensor:
        """Logarithm of sigma of the Gaussian noise within its bounds, shape (action_dim,)."""
        if self.log_std_bounds is None:
            return self.log_std
        return self.log_std.clamp(*self.log_std_bounds)

    def keep_within_bounds(self) -> None:
        if self.log_std_bounds is not None:
            # Beyond its bounds it would have no gradient, and never come back.
            with th.no_grad():
                self.log_std.clamp_(*self.log_std_bounds)

    def draw_latents(self, features: th.Tensor, deterministic: bool) -> th.Tensor:
        """Latents z, or 0 where nothing may be drawn, shape (n, action_dim)."""
        if self.gaussian:
            return features.new_zeros(len(features), self.action_dim)
        return self.latent_std * super().draw_latents(features, deterministic)

    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, PolicyFlowRecord]:
        """Draw actions; the deterministic one has z = 0 and n = 0."""
        latents = self.draw_latents(features, deterministic)
        endpoints = self.carry(latents, features)
        record = PolicyFlowRecord(latents, endpoints)
        if deterministic:
            return endpoints, record
        return endpoints + th.randn_like(endpoints) * self.noise_log_std.exp(), record


MlpFlowPolicy = FlowPolicy


class CnnFlowPolicy(ImageFeatures, FlowPolicy):
    """:class:`FlowPolicy` for images: its default features extractor is SB3's ``NatureCNN``."""


class MultiInputFlowPolicy(DictFeatures, FlowPolicy):
    """:class:`FlowPolicy` for Dict observations, by default with SB3's ``CombinedExtractor``."""
