"""The update that all flow algorithms share: PPO's, for policies without a likelihood."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, cast

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import explained_variance
from typing_extensions import Self

from sb3_policyflow.common import checks, names, options
from sb3_policyflow.common.buffers import DictFlowRolloutBuffer, FlowRolloutBuffer
from sb3_policyflow.common.former_names import keep_former_defaults
from sb3_policyflow.common.graphs import record_losses
from sb3_policyflow.common.minibatches import (
    FlowRolloutBufferSamples,
    Minibatches,
    minibatches_of,
)
from sb3_policyflow.common.optimization import (
    check_step,
    clip_gradients,
    take_step,
)
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.scheduled import ScheduledOnPolicyAlgorithm
from sb3_policyflow.common.schedules import (
    Coefficient,
    KLAdaptiveLearningRate,
    parse_schedule,
)
from sb3_policyflow.common.update import (
    FlowUpdate,
    Loss,
    UpdateMetrics,
    check_model,
)
from sb3_policyflow.device import environments
from sb3_policyflow.distributed.ranks import join, training_of
from sb3_policyflow.kernels import reason_training_is_slow, shares_cores
from sb3_policyflow.resilience.guarded import GuardedOnPolicyAlgorithm
from sb3_policyflow.resilience.resumable import ResumableOnPolicyAlgorithm
from sb3_policyflow.resilience.training import LearnArguments


class FlowOnPolicyAlgorithm(
    GuardedOnPolicyAlgorithm, ResumableOnPolicyAlgorithm, ScheduledOnPolicyAlgorithm
):
    """PPO's update around what a sibling says of its policy, its :class:`FlowUpdate`.

    Takes the arguments of SB3's PPO, in its order and with its meanings, except that gSDE is not
    supported, ``max_grad_norm`` may be None or not positive for no clipping, and coefficients and
    rates may be schedules, also as "lin_START" or "lin_START_END"; and:

    :param desired_kl: Divergence in nats that the adaptive learning rate aims at: a constant,
        "lin_START", "lin_START_END" or a function of the remaining progress. The rate then starts
        at ``learning_rate``. None for no adaptation.
    :param lr_adaptation_kwargs: Options of the adaptive learning rate, those of
        :class:`~sb3_policyflow.common.schedules.KLAdaptiveLearningRate`.
    :param advantage_scope: Where advantages are normalized: in each "minibatch", as SB3 does, or
        over the whole "rollout".
    :param timeout_bootstrap: The value with which an episode cut by a time limit continues: that of
        the "terminal" observation, as in SB3, of the "current" one before it, or "none".
    :param allow_nan_observations: Whether the features extractor can handle observations that are
        not finite, such as NaN for a missing reading. By default they stop the training.
    :param n_critic_warmup: Rollouts at the start from which only the critic learns.
    :param critic_learning_rate: Learning rate of the critic's own parameters, in ``ent_coef``'s
        forms; None for that of the actor, which ``desired_kl`` may adapt.
    :param imitation_coef: Weight of the squared change of the velocity since the policy was cloned
        from demonstrations, see :func:`sb3_policyflow.imitation.clone`. Takes ``ent_coef``'s forms.
    :param policy_options: Options of the policy that are the algorithm's own: the keyword-only
        arguments of its policy class. They may be given in ``policy_kwargs`` instead.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base: ClassVar[type[FlowPolicy]]
    update_class: ClassVar[type[FlowUpdate]]
    former_names: ClassVar[Mapping[str, str]] = options.FORMER_NAMES
    former_defaults: ClassVar[Mapping[str, Any]] = options.FORMER_DEFAULTS
    """Defaults of the policy in version 0.1, where they are others now."""
    former_values: ClassVar[Mapping[str, Any]] = {"has_former_defaults": True}
    has_former_defaults: bool = False
    """Whether a file of version 0.1 was loaded: what it does not say, had other defaults."""
    divergence_advice: ClassVar[str] = ""
    """What else than a lower learning rate helps against gradients that are not finite."""
    option_checks: ClassVar[Mapping[str, checks.Check]] = options.SHARED_CHECKS
    model_checks: ClassVar[tuple[Callable[[Any], None], ...]] = ()
    """Functions that refuse a model whose options do not go together."""
    trust_region: str = "ppo"
    n_rollouts: int = 0
    """Rollouts that the model has learned from."""
    cloned_parameters: dict[str, Any] | None = None
    """Those of the policy after it was cloned from demonstrations."""
    policy: FlowPolicy
    rollout_buffer: FlowRolloutBuffer | DictFlowRolloutBuffer
    # Environments may be of tensors too.
    _wrap_env = staticmethod(environments.wrap)
    _collect = environments.collect

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name in {"random_latents", *names.settable_options(cls.policy_base)}:
            if not hasattr(cls, name):
                setattr(cls, name, options.PolicyOption(name))

    def __init__(
        self,
        policy: str | type[FlowPolicy],
        env: GymEnv | str,
        learning_rate: Coefficient = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: Coefficient = 0.2,
        clip_range_vf: Coefficient | None = None,
        normalize_advantage: bool = True,
        ent_coef: Coefficient = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float | None = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        desired_kl: Coefficient | None = None,
        lr_adaptation_kwargs: dict[str, Any] | None = None,
        advantage_scope: str = "minibatch",
        timeout_bootstrap: str = "terminal",
        allow_nan_observations: bool = False,
        n_critic_warmup: int = 0,
        critic_learning_rate: Coefficient | None = None,
        imitation_coef: Coefficient = 0.0,
        **policy_options: Any,
    ) -> None:
        self.ranks = join(device)
        self.rank = self.ranks.rank
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.clip_range = clip_range
        self.clip_range_vf = clip_range_vf
        self.normalize_advantage = normalize_advantage
        self.target_kl = target_kl
        self.desired_kl = desired_kl
        self.lr_adaptation_kwargs = lr_adaptation_kwargs
        self.advantage_scope = advantage_scope
        self.timeout_bootstrap = timeout_bootstrap
        self.allow_nan_observations = allow_nan_observations
        self.n_critic_warmup = n_critic_warmup
        self.critic_learning_rate = critic_learning_rate
        self.imitation_coef = imitation_coef
        self.policy_options = policy_options
        self.has_former_defaults = False  # an attribute of files
        super().__init__(
            policy,
            environments.registered(env),
            learning_rate=cast(float, learning_rate),  # or a schedule, as ent_coef
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=cast(float, ent_coef),
            vf_coef=vf_coef,
            max_grad_norm=cast(float, max_grad_norm),  # or None
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        options.read_loaded_options(self)
        options.check_algorithm(self)
        self.rollout_buffer_class = checks.choose_buffer_class(
            type(self).__name__, self.rollout_buffer_class, self.observation_space
        )
        own, self.policy_kwargs = self.policy_kwargs, {**self.policy_kwargs, **self.policy_options}
        super()._setup_model()
        self.policy_kwargs = own
        keep_former_defaults(self)
        self.known_policy_options = options.values_on_policy(self)
        self.clip_range = parse_schedule("clip_range", self.clip_range)
        if self.clip_range_vf is not None:
            self.clip_range_vf = parse_schedule("clip_range_vf", self.clip_range_vf)
        self._start_adaptive_learning_rate()
        check_model(self)

    def _maybe_recommend_cpu(self, mlp_class_name: str = "MlpPolicy") -> None:
        super()._maybe_recommend_cpu(self.policy_aliases[mlp_class_name].__name__)

    def _update_learning_rate(
        self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer
    ) -> None:
        options.take_up_changes(self)
        super()._update_learning_rate(optimizers)

    @shares_cores
    def train(self) -> None:
        """Update the policy with the rollout in the buffer (paper, algorithm 1, lines 13 to 23)."""
        self._update_learning_rate(self.policy.optimizer)
        rollout = self._rollout()
        self.policy.set_training_mode(False)
        update = self.update_class(self, rollout)  # line 3: remembers the reference policy
        record_losses(self, update)
        parameters = list(self.policy.parameters())
        rule = KLAdaptiveLearningRate(**(self.lr_adaptation_kwargs or {}))
        metrics, kls = UpdateMetrics(), list[th.Tensor]()
        for _ in range(self.n_epochs):  # line 13
            kls = [] if rule.window == "epoch" else kls
            samples = rollout._replace(drawn=update.draw())  # lines 15 to 17
            self.policy.set_training_mode(True)
            minibatches = self._minibatches(samples, update.batch_size)
            # Line 14, and 18 to 21: ratio, surrogate objective, regularizers, error of the values
            for loss, kl in update.minibatch_losses(minibatches, metrics):
                kls.append(kl)
                stop = self.target_kl is not None and self.ranks.mean(kl) > 1.5 * self.target_kl
                if not stop:
                    self._optimize(loss, parameters, update)  # lines 22 and 23
                if stop or rule.interval == "minibatch":
                    self._adapt_learning_rate(rule, kls[-1:], update.trains_actor)
                if stop:
                    self.logger.info(f"Early stopping due to reaching max kl: {kls[-1].item():.2f}")
                    break
            self._n_updates += 1
            if stop:
                break
            if rule.interval == "epoch":
                self._adapt_learning_rate(rule, kls, update.trains_actor)
        self._log_update(loss, th.stack(kls).mean(), metrics)

    def _rollout(self) -> FlowRolloutBufferSamples:
        """The rollout in the buffer."""
        rollout = self.rollout_buffer.samples()
        if self.normalize_advantage and self.advantage_scope == "rollout":
            return rollout._replace(advantages=self.ranks.normalized(rollout.advantages))
        return rollout

    def _minibatches(self, samples: FlowRolloutBufferSamples, size: int) -> Minibatches:
        """The minibatches of an epoch."""
        minibatches = minibatches_of(self.rollout_buffer, samples, size)
        if self.normalize_advantage and self.advantage_scope == "minibatch":
            minibatches.map_advantages(self.ranks.normalized)
        return minibatches

    def _optimize(self, loss: Loss, parameters: list[th.nn.Parameter], update: FlowUpdate) -> None:
        """Take one step of the optimizer.

        :raises FloatingPointError: If loss or gradient are not finite; parameters do not change.
        """
        for parameter in parameters:
            parameter.grad = None
        trained = None if update.trains_actor else list(self.policy.critic_parameters())
        loss.backward(inputs=trained)
        mean_loss = self.ranks.average_gradients(parameters, loss.item())
        norm = clip_gradients(parameters, self.max_grad_norm)
        check_step(mean_loss, norm, self.num_timesteps, self.divergence_advice)
        take_step(self.policy.optimizer, update.critic_rate)
        self.policy.keep_within_bounds()

    def _log_update(self, loss: Loss, approx_kl: th.Tensor, metrics: UpdateMetrics) -> None:
        """Log what the update did, and count its rollout."""
        self.n_rollouts += 1
        if self.n_rollouts == 1 and (reason := reason_training_is_slow(self.policy)):
            self.logger.info(reason)
        kept = self.rollout_buffer.values, self.rollout_buffer.returns
        arrays = (th.as_tensor(each, device="cpu").numpy().flatten() for each in kept)
        logged: dict[str, Any] = {"approx_kl": approx_kl.item(), "loss": loss.item()}
        logged["explained_variance"] = explained_variance(*arrays)
        if hasattr(self.policy, "log_std"):
            logged["std"] = self.policy.log_std.exp().mean().item()
        for name in ("clip_range", "clip_range_vf"):
            if getattr(self, name) is not None:
                logged[name] = self.value_of(name)
        for name, value in self.ranks.average_metrics({**metrics.summary(), **logged}).items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _prepare_saving(self) -> None:
        options.note_changed_options(self)
        self.read_learning_rate()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "ranks", "known_policy_options"]

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps``; see SB3. Runs are named after the class by default."""
        options.take_up_changes(self)
        rest = log_interval, tb_log_name or type(self).__name__, reset_num_timesteps, progress_bar
        training_of(self).run(super().learn, LearnArguments(total_timesteps, callback, *rest))
        return self
