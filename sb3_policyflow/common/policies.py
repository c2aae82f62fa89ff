"""What the policies of all flow algorithms share: networks, values, and how an action is made."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    FlattenExtractor,
    MlpExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_policyflow.common import checks
from sb3_policyflow.common.critic import CriticExtractor
from sb3_policyflow.common.former_names import FormerAttribute, accepts_former_names
from sb3_policyflow.common.latents import LatentPolicy
from sb3_policyflow.common.losses import matching_losses
from sb3_policyflow.common.names import (
    WithoutLikelihood,
    check_overridden_methods,
    own_options,
)
from sb3_policyflow.common.optimization import make_optimizer
from sb3_policyflow.flows import INITIALIZATIONS, VelocityField
from sb3_policyflow.kernels import (
    GraphMemory,
    KernelCritic,
    are_in_mode,
    has_values,
    make_velocity_field,
)
from sb3_policyflow.resilience.finite import check_actions

NetArch = list[int] | dict[str, list[int]]


class FlowPolicy(LatentPolicy, WithoutLikelihood, ActorCriticPolicy):
    """An actor-critic policy whose actor is a velocity field.

    ``forward`` returns actions, values and a record: a NamedTuple of tensors that says how the
    actions were made. The algorithms' policies differ in :meth:`sample_actions`. Their own options
    are keyword-only, and may be given to the algorithm too.

    :param observation_space: Observation space.
    :param action_space: Action space, a Box.
    :param lr_schedule: Learning rate schedule.
    :param net_arch: Hidden layers of the velocity field (``pi``) and of the critic (``vf``).
        Default: [64, 64] for both, and none for the critic behind a ``NatureCNN``.
    :param activation_fn: Activation of both networks.
    :param ortho_init: Whether to initialize features extractor and critic orthogonally, as SB3
        does. The velocity field has its own ``initialization``.
    :param use_sde: Not supported.
    :param features_extractor_class: Features extractor; by default that of the class.
    :param features_extractor_kwargs: Keyword arguments of the features extractor.
    :param share_features_extractor: Whether actor and critic share the features extractor.
    :param normalize_images: Whether to divide images by 255.
    :param optimizer_class: Optimizer.
    :param optimizer_kwargs: Keyword arguments of the optimizer, except the learning rate.
    :param embedding_dim: Size of the time and observation embeddings.
    :param frequencies: Frequencies of the time embedding, or how many to draw.
    :param frequency_scale: Standard deviation of the frequencies that are drawn.
    :param initialization: "orthogonal", "glorot", "glorot_zero_output" or "zero".
    :param deterministic_action: What ``predict(deterministic=True)`` returns: "mode", of the end
        points of 16 fixed latents the one around which the others lie most densely; "zero", that of
        z = 0, which may lie between modes; or "drawn", that of a random latent. May be set later.
    :raises ValueError: If an option is not supported.
    """

    shared_options: ClassVar[tuple[str, ...]] = (
        "share_features_extractor",
        "embedding_dim",
        "frequencies",
        "frequency_scale",
        "initialization",
        "deterministic_action",
    )
    """Constructor arguments of all flow policies that SB3's ``save`` of a policy does not know."""
    default_features_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    option_checks: ClassVar[Mapping[str, checks.Check]] = {
        "embedding_dim": checks.at_least(1),
        "initialization": checks.one_of(INITIALIZATIONS),
        "deterministic_action": checks.one_of(("mode", "zero", "drawn")),
    }

    fixed_options: ClassVar[frozenset[str]] = frozenset()
    """Own options that cannot change, because networks or parameters were made with them."""

    velocity: VelocityField
    mlp_extractor: MlpExtractor
    random_latents = FormerAttribute("deterministic_action")

    @accepts_former_names(initialisation="initialization", random_latents="deterministic_action")
    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        ortho_init: bool = True,
        use_sde: bool = False,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = True,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        embedding_dim: int = 64,
        frequencies: int | Sequence[float] | None = None,
        frequency_scale: float = 1.0,
        initialization: str = "orthogonal",
        deterministic_action: str = "mode",
    ) -> None:
        checks.check_flow_spaces(action_space, use_sde)
        checks.check_networks(net_arch, activation_fn, optimizer_class, features_extractor_class)
        check_overridden_methods(type(self), FlowPolicy)
        self.embedding_dim = embedding_dim
        self.frequencies = frequencies
        self.frequency_scale = frequency_scale
        self.initialization = initialization
        self.deterministic_action = deterministic_action
        checks.check_options(self)
        features_extractor_class = features_extractor_class or self.default_features_extractor_class
        if net_arch is None and features_extractor_class is NatureCNN:
            # SB3 puts no layer behind its CNN, but a velocity without one is linear in the action.
            net_arch = {"pi": [64, 64], "vf": []}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            ortho_init=ortho_init,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            share_features_extractor=share_features_extractor,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for foreign in ("use_sde", "full_std", "use_expln", "squash_output", "log_std_init"):
            del data[foreign]
        own = [option.name for option in own_options(type(self)) if hasattr(self, option.name)]
        return {**data, **{name: getattr(self, name) for name in (*self.shared_options, *own)}}

    def _layers(self, head: str) -> list[int]:
        """Hidden layers of the actor ("pi") or the critic ("vf")."""
        arch = self.net_arch
        return list(arch.get(head, [])) if isinstance(arch, dict) else list(arch)

    def _build_mlp_extractor(self) -> None:
        """Build the critic's hidden layers; the actor's belong to the velocity field.

        If a subclass builds others, the velocity gets what their ``forward_actor`` returns.
        """
        self.mlp_extractor = CriticExtractor(
            self.features_dim, self._layers("vf"), self.activation_fn, self.device
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # SB3 has made those of a Gaussian actor, and the optimizer of its parameters.
        del self.action_net, self.action_dist, self.log_std
        self._build_actor()
        self._kernel_critic = KernelCritic()
        self.graph_memory = GraphMemory()
        fixed = "velocity.time_embedding.frequencies"  # of the velocity, and of a copy of it
        learned = (p for name, p in self.named_parameters() if not name.endswith(fixed))
        self.optimizer = make_optimizer(
            self.optimizer_class, learned, lr_schedule(1), self.optimizer_kwargs
        )

    @abstractmethod
    def _build_actor(self) -> None:
        """Build what the actor learns: ``velocity``, and what else the policy has."""

    def _make_velocity_field(self) -> VelocityField:
        return make_velocity_field(
            self.action_dim,
            self.mlp_extractor.latent_dim_pi,
            net_arch=self._layers("pi"),
            activation_fn=self.activation_fn,
            embedding_dim=self.embedding_dim,
            frequencies=self.frequencies,
            frequency_scale=self.frequency_scale,
            initialization=self.initialization,
        )

    def critic_parameters(self) -> Iterator[nn.Parameter]:
        """The parameters that serve the critic alone."""
        yield from self.mlp_extractor.value_net.parameters()
        yield from self.value_net.parameters()
        if not self.share_features_extractor:
            yield from self.vf_features_extractor.parameters()

    def actor_features(self, obs: PyTorchObs) -> th.Tensor:
        """Features for the actor, shape (n, features_dim)."""
        is_own = type(self).extract_features is not ActorCriticPolicy.extract_features
        if self.share_features_extractor or is_own:
            features = self.extract_features(obs)
        else:
            # BasePolicy's serves one extractor, ActorCriticPolicy's both.
            extract = super(ActorCriticPolicy, self).extract_features
            features = extract(obs, self.pi_features_extractor)
        actor = features[0] if isinstance(features, tuple) else features
        return self.mlp_extractor.forward_actor(actor)

    def actor_critic_features(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Features for actor and critic, extracted once where they are shared."""
        features = self.extract_features(obs)
        actor, critic = features if isinstance(features, tuple) else (features, features)
        return self.mlp_extractor.forward_actor(actor), critic

    def set_training_mode(self, mode: bool) -> None:
        """Put the policy in training or evaluation mode; see SB3, which does so in each predict."""
        if not are_in_mode(self, mode):
            super().set_training_mode(mode)

    def values(self, features: th.Tensor) -> th.Tensor:
        """Estimated values of states with these features, shape (n, 1)."""
        values = self._kernel_critic(self, features)
        if values is None:
            values = self.value_net(self.mlp_extractor.forward_critic(features))
        return values

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """Estimated values of states, shape (n, 1), by kernels, which wake no threads of torch."""
        extract = super(ActorCriticPolicy, self).extract_features  # as SB3 does
        return self.values(extract(obs, self.vf_features_extractor))

    @property
    @abstractmethod
    def n_evaluations_per_action(self) -> int:
        """Evaluations of the velocity field for one action."""

    @abstractmethod
    def sample_actions(
        self, features: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, Any]:
        """Draw actions.

        :param features: The actor's features, shape (n, features_dim).
        :param deterministic: Whether to draw nothing at random.
        :return: Actions, shape (n, action_dim), and the record of how they were made.
        """

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, Any]:
        """Act and estimate values.

        :param obs: Observations of n environments.
        :param deterministic: Whether to draw nothing at random.
        :return: Actions (n, ...), values (n, 1), and the record of the actions.
        """
        actor_features, critic_features = self.actor_critic_features(obs)
        actions, record = self.sample_actions(actor_features, deterministic)
        return self._finished(actions), self.values(critic_features), record

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        actions, _ = self.sample_actions(self.actor_features(observation), deterministic)
        return self._finished(actions)

    def _finished(self, actions: th.Tensor) -> th.Tensor:
        """Actions in the shape of their space, (n, ...), all of them finite."""
        assert self.action_space.shape is not None
        if has_values():
            check_actions(actions)
        return actions.reshape(-1, *self.action_space.shape)

    def cloning_losses(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Losses of demonstrated actions, shape (n,); cloning minimizes their mean.

        By default those of flow matching, along the points that ``draw_matching`` draws.

        :param features: The actor's features, shape (n, features_dim).
        :param actions: What was demonstrated, shape (n, action_dim).
        """
        return matching_losses(self, features, actions)

    def finish_cloning(self, noise_std: float | None) -> None:
        """Called when the actor was cloned from demonstrations; does nothing by default.

        :param noise_std: Standard deviation of the noise to go on with, see
            :func:`sb3_policyflow.imitation.clone`; None for the default.
        """

    def keep_within_bounds(self) -> None:
        """Clamp parameters that have bounds, after a step of the optimizer."""


FlowActorCriticPolicy = FlowPolicy
"""Deprecated alias of :class:`FlowPolicy`."""
