"""Policies of PolicyFlow: an action is the end point of a flow plus Gaussian noise."""

import math
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_policyflow.common import checks
from sb3_policyflow.common.continuous import ContinuousFlowPolicy
from sb3_policyflow.common.former_names import accepts_former_names
from sb3_policyflow.common.options import FlowOptions
from sb3_policyflow.flows import INTERPOLANTS, SOLVERS, Flow
from sb3_policyflow.flows.bounds import half_ranges


class PolicyFlowOptions(FlowOptions, total=False):
    """The shared options, and those of the policy."""

    interpolant: str
    n_flow_steps: int
    solver: str
    latent_std: float | None
    gaussian: bool
    log_std_init: float
    log_std_bounds: tuple[float, float] | None


LATENT_STD = 0.2
"""Standard deviation of the latents, in half the distance of the actions' bounds."""

CLONED_NOISE = 0.1
"""Standard deviation of the noise after cloning, in half the distance of the actions' bounds; where
there are none that mean something, as if they were -1 and 1."""
HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


class PolicyFlowRecord(NamedTuple):
    """How an action was made: latents z and end points phi, each of shape (n, action_dim)."""

    latents: th.Tensor
    endpoints: th.Tensor


def check_latents(policy: "PolicyFlowPolicy") -> None:
    """Refuse latents of another standard deviation where there are none, or none of their own.

    :raises ValueError: With what to leave out.
    """
    if policy.latent_std in (None, 1.0):
        return
    if policy.gaussian:
        raise ValueError("With gaussian=True latents are 0: leave out latent_std.")
    if INTERPOLANTS[policy.interpolant].stochastic:
        raise ValueError(
            f"With interpolant={policy.interpolant!r} the latents' standard deviation is 1: leave "
            "out latent_std, or use interpolant='rectified' or interpolant='trigflow'."
        )


class PolicyFlowPolicy(ContinuousFlowPolicy):
    """Actor-critic policy that transports Gaussian latents along a flow (paper, policy).

    z ~ N(0, s_z^2),  dx/dt = v(x, t, s) from x_0 = z to phi = x_T,  a = phi + n,  n ~ N(0, sigma^2)

    Latents spread the actions, and the importance ratio does not see that. In the paper s_z is 1;
    where actions are bounded by 1, such latents would drown the noise that the ratio sees. By
    default s_z is a fifth of half the range of each action: 1 on the paper's MultiGoal.

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowPolicy`, and:

    :param interpolant: "rectified", "stochastic", "stochastic_exact" or "trigflow": the points at
        which the update compares velocities. Its ``end_time`` T is where the flow ends.
    :param n_flow_steps: Solver steps from z to phi, which also make the grid of the update's times.
        The paper has 12, which follow a flow to several good actions more accurately.
    :param solver: "euler", "midpoint", "heun", "rk4" or "ab2".
    :param latent_std: Standard deviation s_z of the latents z, greater than 0. None for a fifth of
        half the range of each action. It is 1 where bounds are 200 or more apart, as they stand for
        none, and with a stochastic interpolant, which needs that.
    :param gaussian: Whether z is always 0, which leaves a Gaussian policy with mean phi.
    :param log_std_init: Initial log standard deviation of the Gaussian noise.
    :param log_std_bounds: Lowest and highest log standard deviation of the noise; None for none.
    :raises ValueError: If an option is not supported.
    """

    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "interpolant": checks.one_of(INTERPOLANTS),
        "n_flow_steps": checks.at_least(1),
        "solver": checks.one_of(SOLVERS),
        "latent_std": checks.or_none(checks.positive),
        "log_std_init": checks.finite,
        "log_std_bounds": checks.or_none(checks.bounds),
    }
    combination_checks = (check_latents,)
    latent_stds: th.Tensor
    fixed_options = frozenset({"log_std_init"})

    @accepts_former_names(path="interpolant")
    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *args: Any,
        interpolant: str = "rectified",
        n_flow_steps: int = 4,
        solver: str = "midpoint",
        latent_std: float | None = None,
        gaussian: bool = False,
        log_std_init: float = 0.0,
        log_std_bounds: tuple[float, float] | None = None,
        **kwargs: Any,
    ) -> None:
        self.interpolant = interpolant
        self.n_flow_steps = n_flow_steps
        self.solver = solver
        self.latent_std = latent_std
        self.gaussian = gaussian
        self.log_std_init = log_std_init
        self.log_std_bounds = log_std_bounds
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)
        # SB3 has set both to the defaults of its own actor.
        self.log_std_init = log_std_init
        nn.init.constant_(self.log_std, log_std_init)
        self.keep_within_bounds()

    def _build_actor(self) -> None:
        super()._build_actor()
        assert isinstance(self.action_space, spaces.Box)
        ranges = half_ranges(self.action_space.low, self.action_space.high)
        stds = np.where(np.isfinite(ranges), LATENT_STD * ranges, 1.0)
        self._latent_std_of_all = float(stds[0]) if (stds == stds[0]).all() else None
        like_weights: Any = {"dtype": th.float32, "device": "cpu"}
        self.register_buffer("latent_stds", th.as_tensor(stds, **like_weights), persistent=False)
        self.log_std = nn.Parameter(th.zeros(self.action_dim))

    @property
    def latent_scale(self) -> float | th.Tensor:
        if self.gaussian:
            return 0.0
        if self.latent_std is not None:
            return self.latent_std
        if INTERPOLANTS[self.interpolant].stochastic:
            return 1.0
        return self.latent_stds if self._latent_std_of_all is None else self._latent_std_of_all

    @property
    def flow(self) -> Flow:
        """The flow from latents to end points."""
        interpolant = INTERPOLANTS[self.interpolant]()
        return Flow(self.velocity, interpolant, self.solver, self.n_flow_steps)

    @property
    def noise_log_std(self) -> th.Tensor:
        """Logarithm of sigma of the Gaussian noise within its bounds, shape (action_dim,)."""
        if self.log_std_bounds is None:
            return self.log_std
        return self.log_std.clamp(*self.log_std_bounds)

    def keep_within_bounds(self) -> None:
        if self.log_std_bounds is not None:
            # Beyond its bounds log_std would have no gradient, and never come back.
            with th.no_grad():
                self.log_std.clamp_(*self.log_std_bounds)

    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, PolicyFlowRecord]:
        """Draw actions (paper, algorithm 1, lines 6 to 8); deterministic ones have no noise n."""
        latents, endpoints = self.draw_endpoints(features, deterministic)
        record = PolicyFlowRecord(latents, endpoints)
        if deterministic:
            return endpoints, record
        return endpoints + th.randn_like(endpoints) * self.noise_log_std.exp(), record

    def cloning_losses(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """As in the base class; of a Gaussian policy, minus the log likelihood."""
        if not self.gaussian:
            return super().cloning_losses(features, actions)
        latents = features.new_zeros(len(features), self.action_dim)
        noise = (actions - self.transport(latents, features)) / self.noise_log_std.exp()
        log_scales = self.noise_log_std + HALF_LOG_2_PI
        return (0.5 * noise.square() + log_scales).sum(dim=-1)

    def finish_cloning(self, noise_std: float | None) -> None:
        """Set the noise, which a Gaussian policy has learned and keeps."""
        if self.gaussian:
            return
        assert isinstance(self.action_space, spaces.Box)
        ranges = half_ranges(self.action_space.low, self.action_space.high)
        stds = CLONED_NOISE * np.where(np.isfinite(ranges), ranges, 1.0)
        if noise_std is not None:
            stds = np.full_like(stds, noise_std)
        wanted = th.as_tensor(np.log(stds)).to(self.log_std)
        with th.no_grad():
            self.log_std.copy_(wanted)
        self.keep_within_bounds()
        if not th.allclose(self.log_std, wanted):
            warnings.warn(
                f"The noise after cloning is {self.log_std.exp().mean():.3g} and not "
                f"{wanted.exp().mean():.3g}, because of log_std_bounds={self.log_std_bounds}.",
                stacklevel=3,
            )


MlpFlowPolicy = PolicyFlowPolicy


class CnnFlowPolicy(PolicyFlowPolicy):
    """:class:`PolicyFlowPolicy` for images: its default features extractor is ``NatureCNN``."""

    default_features_extractor_class = NatureCNN


class MultiInputFlowPolicy(PolicyFlowPolicy):
    """:class:`PolicyFlowPolicy` for Dict observations, by default with ``CombinedExtractor``."""

    default_features_extractor_class = CombinedExtractor


FlowPolicy = PolicyFlowPolicy
"""Deprecated alias of :class:`PolicyFlowPolicy`, under which earlier versions saved it."""
