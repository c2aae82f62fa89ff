"""Policies of DPPO: an action is the end of a chain of Gaussian steps."""

import warnings
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_policyflow.common import checks
from sb3_policyflow.common.options import FlowOptions
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.flows import MatchingSamples
from sb3_policyflow.flows.bounds import SHORTEST_MEANINGLESS
from sb3_policyflow.flows.denoising import DDPM, DenoisingProcess, EulerChain, Steps


class DPPOOptions(FlowOptions, total=False):
    """The shared options, and those of the policy."""

    process: str
    n_denoising_steps: int
    n_finetuned_steps: int | None
    min_sampling_std: float
    min_log_prob_std: float
    noise_clip: float | None
    denoised_clip: float
    identity_skip: bool


class DPPORecord(NamedTuple):
    """How an action was made, over the k steps of the chain that are trained.

    Points x (n, k + 1, action_dim), the last of which is the action before its bounds, and the
    means around which all but the first were drawn (n, k, action_dim).
    """

    points: th.Tensor
    means: th.Tensor


ADVICE = (
    "use process='flow', which does not scale, or give the environment bounds that mean something "
    "(gymnasium.wrappers.TransformAction)"
)


def _check_bounds(action_space: spaces.Space[Any]) -> None:
    """Refuse bounds so wide that "ddpm" cannot scale actions to them."""
    assert isinstance(action_space, spaces.Box)
    with np.errstate(over="ignore"):
        widths = action_space.high - action_space.low
    if not np.isfinite(widths).all():
        raise ValueError(
            "process='ddpm' scales actions to their bounds, but those from "
            f"{action_space.low.min():g} to {action_space.high.max():g} are further apart than a "
            f"{widths.dtype} can tell: {ADVICE}."
        )


def warn_of_wide_bounds(policy: "DPPOPolicy") -> None:
    """Warn where bounds seem to mean nothing, to which "ddpm" scales actions nevertheless.

    An untrained policy has a standard deviation of about a fifth of their distance, and what it
    explores in the end is in proportion to it, too.

    :param policy: A policy that has not been trained.
    """
    box: Any = policy.action_space
    if policy.process != "ddpm":
        return
    width = (box.high - box.low).max()
    if width >= SHORTEST_MEANINGLESS:
        warnings.warn(
            f"process='ddpm' scales actions to their bounds, which are up to {width:g} apart: the "
            f"standard deviation of untrained actions is about {0.19 * width:.2g}. If these bounds "
            f"stand for none, {ADVICE}.",
            stacklevel=4,
        )


class DPPOPolicy(FlowPolicy):
    """Actor-critic policy that denoises an action in several steps.

    x_0 ~ N(0, I),    x_{k+1} ~ N(m_k(x_k, s), max(s_k, s_min)^2 I),    a = x_K

    With "ddpm", the chain's end lies in [-1, 1], which is scaled to the action space.

    Takes the arguments of :class:`~sb3_policyflow.common.policies.FlowPolicy`, and:

    :param process: "ddpm", or "flow" for Euler steps with noise of a fixed standard deviation.
    :param n_denoising_steps: K, steps from noise to action.
    :param n_finetuned_steps: How many of them, the last ones, are trained; the others belong to a
        frozen copy of the networks, see :meth:`freeze_base`. All if None.
    :param min_sampling_std: s_min, least standard deviation of a step.
    :param min_log_prob_std: Least standard deviation that the likelihood of a step is taken with.
    :param noise_clip: Bound of a step's noise, in its standard deviations; None for none.
    :param denoised_clip: Bound of the action that "ddpm" predicts in each step.
    :param identity_skip: Whether "ddpm" adds the point to the network's output in predicting its
        noise, which keeps untrained policies off the bounds of the actions.
    :raises ValueError: If an option is not supported.
    """

    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "process": checks.one_of(("ddpm", "flow")),
        "n_denoising_steps": checks.at_least(1),
        "n_finetuned_steps": checks.or_none(checks.at_least(1)),
        "min_sampling_std": checks.positive,
        "min_log_prob_std": checks.positive,
        "noise_clip": checks.or_none(checks.positive),
        "denoised_clip": checks.positive,
    }
    fixed_options = frozenset(
        {"process", "n_denoising_steps", "n_finetuned_steps", "denoised_clip", "identity_skip"}
    )

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *args: Any,
        process: str = "ddpm",
        n_denoising_steps: int = 10,
        n_finetuned_steps: int | None = None,
        min_sampling_std: float = 0.1,
        min_log_prob_std: float = 0.1,
        noise_clip: float | None = 3.0,
        denoised_clip: float = 1.0,
        identity_skip: bool = True,
        **kwargs: Any,
    ) -> None:
        self.process = process
        self.n_denoising_steps = n_denoising_steps
        self.n_finetuned_steps = n_finetuned_steps
        self.min_sampling_std = min_sampling_std
        self.min_log_prob_std = min_log_prob_std
        self.noise_clip = noise_clip
        self.denoised_clip = denoised_clip
        self.identity_skip = identity_skip
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)
        # SB3 then scales the actions from [-1, 1] to their space.
        self._squash_output = process == "ddpm"

    def _build_actor(self) -> None:
        self.velocity = self._make_velocity_field()
        n_trained = self.n_finetuned_steps or self.n_denoising_steps
        self.n_frozen_steps = self.n_denoising_steps - n_trained
        if self.n_frozen_steps < 0:
            raise ValueError(
                "n_finetuned_steps must be some of the n_denoising_steps="
                f"{self.n_denoising_steps}, got {self.n_finetuned_steps}."
            )
        self.chain: DenoisingProcess
        if self.process == "ddpm":
            _check_bounds(self.action_space)
            self.chain = DDPM(self.n_denoising_steps, self.denoised_clip, self.identity_skip)
        else:
            self.chain = EulerChain(self.n_denoising_steps)
        if self.n_frozen_steps > 0:
            self.base_velocity = deepcopy(self.velocity).requires_grad_(False)
            self.base_features_extractor = deepcopy(self.pi_features_extractor)
            self.base_features_extractor.requires_grad_(False)
            if self._has_own_networks:
                self.base_mlp_extractor = deepcopy(self.mlp_extractor).requires_grad_(False)

    @property
    def latent_scale(self) -> float:
        return 1.0

    @property
    def n_evaluations_per_action(self) -> int:
        return self.n_denoising_steps

    def freeze_base(self) -> None:
        """Let the steps that are not trained use the networks as they are now, say after imitation.

        These are the velocity field, the actor's features extractor, and networks between them of
        one's own.
        """
        if self.n_frozen_steps > 0:
            self.base_velocity.load_state_dict(self.velocity.state_dict())
            extractor = self.pi_features_extractor.state_dict()
            self.base_features_extractor.load_state_dict(extractor)
            if self._has_own_networks:
                self.base_mlp_extractor.load_state_dict(self.mlp_extractor.state_dict())

    def finish_cloning(self, noise_std: float | None) -> None:  # noqa: ARG002
        """Freeze what was cloned; the noise is the chain's own."""
        self.freeze_base()

    def actor_features(self, obs: PyTorchObs) -> th.Tensor:
        """Features for the actor, shape (n, features_dim).

        Where some steps are frozen and the extractor learns, (n, 2 features_dim): behind those for
        the trained steps those for the frozen ones.
        """
        return self._with_base(super().actor_features(obs), obs)

    def actor_critic_features(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Features for actor and critic, extracted once where they are shared."""
        actor_features, critic_features = super().actor_critic_features(obs)
        return self._with_base(actor_features, obs), critic_features

    @property
    def _has_base_features(self) -> bool:
        learns = any(True for _ in self.pi_features_extractor.parameters())
        return self.n_frozen_steps > 0 and (learns or self._has_own_networks)

    @property
    def _has_own_networks(self) -> bool:
        """Whether a policy of the user's own puts networks between extractor and velocity."""
        return type(self)._build_mlp_extractor is not FlowPolicy._build_mlp_extractor

    def _with_base(self, features: th.Tensor, obs: PyTorchObs) -> th.Tensor:
        if not self._has_base_features:
            return features
        base = super(ActorCriticPolicy, self).extract_features(obs, self.base_features_extractor)
        if self._has_own_networks:
            base = self.base_mlp_extractor.forward_actor(base)
        return th.cat([features, base], dim=-1)

    @property
    def log_prob_stds(self) -> th.Tensor:
        """Standard deviations that likelihoods of the trained steps are taken with, shape (k,)."""
        return self.chain.stds[self.n_frozen_steps :].clamp(min=self.min_log_prob_std)

    def trained_means(self, points: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Means of the trained steps.

        :param points: Where each step starts, shape (n, k, action_dim).
        :param features: The actor's features, shape (n, features_dim).
        :return: Shape (n, k, action_dim).
        """
        return self.step_means(points, slice(self.n_frozen_steps, None), features.unsqueeze(1))

    def step_means(self, points: th.Tensor, steps: Steps, features: th.Tensor) -> th.Tensor:
        """Means of one step or of several, of which frozen ones use the base networks.

        :param points: Where the steps start, shape (n, action_dim), or (n, k, action_dim) for k.
        :param steps: Index of the step, or a slice of trained ones.
        :param features: The actor's features, of a shape that broadcasts with that of the points.
        :return: Of the shape of the points.
        """
        is_frozen = isinstance(steps, int) and steps < self.n_frozen_steps
        network = self.base_velocity if is_frozen else self.velocity
        if self._has_base_features:
            trained, base = features.tensor_split(2, dim=-1)
            features = base if is_frozen else trained
        return self.chain.means(points, network(points, self.chain.times[steps], features), steps)

    def draw_matching(self, endpoints: th.Tensor) -> MatchingSamples:
        """Draw where denoising is trained on the way to end points of the chain (n, dim)."""
        return self.chain.draw_matching(endpoints)

    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, DPPORecord]:
        """Draw actions; in deterministic ones each step goes to its mean."""
        latents, _ = self.draw_latents(features, deterministic)
        points, means = self._chain(latents, features, is_noisy=not deterministic)
        record = DPPORecord(
            th.stack(points[self.n_frozen_steps :], dim=1),
            th.stack(means[self.n_frozen_steps :], dim=1),
        )
        return self._bounded(points[-1]), record

    def transport(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """Transport latents x_0 along the means of all steps; see the base class."""
        points, _ = self._chain(latents, features, is_noisy=False)
        return self._bounded(points[-1])

    def _chain(
        self, latents: th.Tensor, features: th.Tensor, is_noisy: bool
    ) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """The K + 1 points of a chain, and the K means around which all but the first lie."""
        points, means = [latents], list[th.Tensor]()
        stds = self.chain.stds.clamp(min=self.min_sampling_std)
        for step in range(self.n_denoising_steps):
            means.append(self.step_means(points[-1], step, features))
            points.append(self._noisy(means[-1], stds[step]) if is_noisy else means[-1])
        return points, means

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        """Scale actions from [-1, 1] to their space, see SB3, whose rounding may leave it."""
        box = self.action_space
        assert isinstance(box, spaces.Box)
        return super().unscale_action(scaled_action).clip(box.low, box.high)

    def _bounded(self, actions: th.Tensor) -> th.Tensor:
        return actions.clamp(-1, 1) if self.squash_output else actions

    def _noisy(self, means: th.Tensor, std: th.Tensor) -> th.Tensor:
        noise = th.randn_like(means)
        if self.noise_clip is not None:
            noise = noise.clamp(-self.noise_clip, self.noise_clip)
        return means + std * noise


MlpFlowPolicy = DPPOPolicy


class CnnFlowPolicy(DPPOPolicy):
    """:class:`DPPOPolicy` for images: its default features extractor is ``NatureCNN``."""

    default_features_extractor_class = NatureCNN


class MultiInputFlowPolicy(DPPOPolicy):
    """:class:`DPPOPolicy` for Dict observations, by default with ``CombinedExtractor``."""

    default_features_extractor_class = CombinedExtractor
