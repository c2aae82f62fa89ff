"""The update that all flow algorithms share: PPO's, for policies without a likelihood."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance, update_learning_rate
from typing_extensions import Self

from sb3_policyflow.common import checks, names, options
from sb3_policyflow.common.buffers import DictFlowRolloutBuffer, FlowRolloutBuffer
from sb3_policyflow.common.losses import clipped_value_loss
from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.schedules import (
    Coefficient,
    KLAdaptiveLearningRate,
    parse_schedule,
    start_adaptive_learning_rate,
)
from sb3_policyflow.common.update import FlowUpdate, UpdateMetrics, check_step, clip_gradients
from sb3_policyflow.distributed.algorithm import DistributedOnPolicyAlgorithm
from sb3_policyflow.kernels import reason_kernels_are_off


class FlowOnPolicyAlgorithm(DistributedOnPolicyAlgorithm):
    """PPO's update around what a sibling says of its policy, its :class:`FlowUpdate`.

    Takes the arguments of SB3's PPO, in its order and with its meanings, except that gSDE is not
    supported, ``max_grad_norm`` may be None or not positive for no clipping, and ``ent_coef`` may
    be a schedule; and:

    :param desired_kl: Target of the KL-adaptive learning rate, which starts at ``learning_rate``:
        a constant, "lin_START", "lin_START_END" or a function of the remaining progress; None to
        follow ``learning_rate``.
    :param lr_adaptation_kwargs: Options of the adaptive learning rate, those of
        :class:`~sb3_policyflow.common.schedules.KLAdaptiveLearningRate`.
    :param advantage_scope: Where advantages are normalized: in each "minibatch", as SB3 does, or
        over the whole "rollout".
    :param timeout_bootstrap: The value with which an episode cut by a time limit continues: that of
        the "terminal" observation, as in SB3, of the "current" one before it, or "none".
    :param allow_nan_observations: Whether the features extractor can handle observations that are
        not finite, such as NaN for a missing reading. By default they stop the training.
    :param policy_options: Options of the policy that are the algorithm's own: the keyword-only
        arguments of its policy class. They may be given in ``policy_kwargs`` instead.
    :raises ValueError: If an argument cannot be used.
    """

    policy_base: ClassVar[type[FlowPolicy]]
    update_class: ClassVar[type[FlowUpdate]]
    former_names: ClassVar[Mapping[str, str]] = options.FORMER_NAMES
    divergence_advice: ClassVar[str] = ""
    """What else than a lower learning rate helps against gradients that are not finite."""
    option_checks: ClassVar[Mapping[str, checks.Check]] = options.SHARED_CHECKS
    unsaved = (*DistributedOnPolicyAlgorithm.unsaved, "_learning_rates", "known_policy_options")
    progress_attributes = ("n_rollouts", "adaptive_learning_rate", "_adaptive_start")
    model_checks: ClassVar[tuple[Callable[[Any], None], ...]] = ()
    """Functions that refuse a model whose options do not go together."""
    trust_region: str = "ppo"
    policy: FlowPolicy
    rollout_buffer: FlowRolloutBuffer | DictFlowRolloutBuffer
    _learning_rates: tuple[Any, Schedule]  # the rate, and the schedule that was made of it

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name in names.settable_options(cls.policy_base):
            if not hasattr(cls, name):
                setattr(cls, name, options.PolicyOption(name))

    def __init__(
        self,
        policy: str | type[FlowPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
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
        **policy_options: Any,
    ) -> None:
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
        self.policy_options = policy_options
        self.n_rollouts = 0
        self.adaptive_learning_rate: float | None = None
        self._adaptive_start: float | None = None
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
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
        self.known_policy_options = options.values_on_policy(self)
        self.clip_range = FloatSchedule(self.clip_range)
        if self.clip_range_vf is not None:
            self.clip_range_vf = FloatSchedule(self.clip_range_vf)
        start_adaptive_learning_rate(self)
        for check in self.model_checks:
            check(self)

    def _maybe_recommend_cpu(self, mlp_class_name: str = "MlpPolicy") -> None:
        super()._maybe_recommend_cpu(self.policy_aliases[mlp_class_name].__name__)

    def value_of(self, name: str) -> float:
        """The value of an option that may be a schedule, at the present progress.

        :param name: The option, such as "ent_coef".
        """
        schedule = parse_schedule(name, getattr(self, name))
        return float(schedule(self._current_progress_remaining))

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        self._learning_rates = self.learning_rate, self.lr_schedule

    def read_learning_rate(self) -> None:
        """Take up a ``learning_rate`` or ``lr_schedule`` that has been set."""
        learning_rate, schedule = self._learning_rates
        if self.lr_schedule is not schedule:
            self.learning_rate = self.lr_schedule
        if self.learning_rate is not learning_rate:
            self._setup_lr_schedule()

    def _update_learning_rate(
        self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer
    ) -> None:
        options.take_up_changes(self)
        start_adaptive_learning_rate(self)
        if self.adaptive_learning_rate is None:
            super()._update_learning_rate(optimizers)
            return
        self.logger.record("train/learning_rate", self.adaptive_learning_rate)
        update_learning_rate(self.policy.optimizer, self.adaptive_learning_rate)

    def _adapt_learning_rate(
        self, rule: KLAdaptiveLearningRate, kls: list[th.Tensor], trains_actor: bool
    ) -> None:
        """Move the learning rate, if it is adaptive, by the mean of some divergences."""
        # An actor that does not learn gives no reason to learn faster.
        if self.adaptive_learning_rate is None or not trains_actor:
            return
        self.adaptive_learning_rate = rule.adapt(
            self.adaptive_learning_rate,
            self.ranks.mean(th.stack(kls).mean()),
            self.value_of("desired_kl"),
        )
        update_learning_rate(self.policy.optimizer, self.adaptive_learning_rate)

    def train(self) -> None:
        """Update the policy with the rollout in the buffer (paper, algorithm 1, lines 13 to 23)."""
        self._update_learning_rate(self.policy.optimizer)
        rollout = self.rollout_buffer.samples()
        rollout = rollout._replace(advantages=self._normalized(rollout.advantages, "rollout"))
        self.policy.set_training_mode(False)
        update = self.update_class(self, rollout)  # line 3: remembers the reference policy
        clip_range_vf = None if self.clip_range_vf is None else self.value_of("clip_range_vf")
        parameters = list(self.policy.parameters())
        rule = KLAdaptiveLearningRate(**(self.lr_adaptation_kwargs or {}))
        metrics, kls = UpdateMetrics(), list[th.Tensor]()
        batch_size = self.ranks.share("batch_size", self.batch_size)
        for _ in range(self.n_epochs):  # line 13
            kls = [] if rule.window == "epoch" else kls
            samples = rollout._replace(drawn=update.draw())  # lines 15 to 17
            self.policy.set_training_mode(True)
            for batch in self.rollout_buffer.minibatches(samples, batch_size):  # line 14
                features, critic_features = self.policy.actor_critic_features(batch.observations)
                terms = update.terms(batch, features)  # lines 18, 20 and 21: ratio, regularizers
                advantages = self._normalized(batch.advantages, "minibatch")
                policy_loss = update.surrogate_loss(terms.log_ratio, advantages, metrics)  # line 19
                # Squared error of the values against the TD(lambda) returns
                values = self.policy.values(critic_features).flatten()
                value_loss = clipped_value_loss(
                    values, batch.old_values, batch.returns, clip_range_vf
                )
                metrics.add_means({"value_loss": value_loss, **terms.metrics})
                loss = policy_loss + terms.regularizer + self.vf_coef * value_loss
                kls.append(terms.kl.detach())
                stop = (
                    self.target_kl is not None and self.ranks.mean(kls[-1]) > 1.5 * self.target_kl
                )
                if not stop:
                    self._optimize(loss, parameters, update.trains_actor)  # lines 22 and 23
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

    def _normalized(self, advantages: th.Tensor, scope: str) -> th.Tensor:
        """Advantages, shape (n,), normalized if this is the scope in which that is done."""
        # One sample has no standard deviation.
        n_samples = self.ranks.size * len(advantages)
        if self.normalize_advantage and self.advantage_scope == scope and n_samples > 1:
            mean, std = self.ranks.mean_std(advantages)
            return (advantages - mean) / (std + 1e-8)
        return advantages

    def _optimize(
        self, loss: th.Tensor, parameters: list[th.nn.Parameter], trains_actor: bool
    ) -> None:
        """Take one step of the optimizer.

        :raises FloatingPointError: If loss or gradient are not finite; parameters do not change.
        """
        for parameter in parameters:
            parameter.grad = None
        trained = None if trains_actor else list(self.policy.critic_parameters())
        th.autograd.backward(loss, inputs=trained)
        loss = self.ranks.average_gradients(parameters, loss)
        norm = clip_gradients(parameters, self.max_grad_norm)
        check_step(loss.item(), norm, self.num_timesteps, self.divergence_advice)
        self.policy.optimizer.step()
        self.policy.keep_within_bounds()

    def _log_update(self, loss: th.Tensor, approx_kl: th.Tensor, metrics: UpdateMetrics) -> None:
        """Log what the update did, and count its rollout."""
        self.n_rollouts += 1
        if self.n_rollouts == 1 and (reason := reason_kernels_are_off(self.policy)):
            self.logger.info(f"PyTorch replaces the compiled kernels and is slower: {reason}.")
        kept = self.rollout_buffer.values, self.rollout_buffer.returns
        values, returns = (th.as_tensor(each).cpu().numpy() for each in kept)
        logged: dict[str, Any] = {"approx_kl": approx_kl.item(), "loss": loss.item()}
        logged["explained_variance"] = explained_variance(values.flatten(), returns.flatten())
        if hasattr(self.policy, "log_std"):
            logged["std"] = self.policy.log_std.exp().mean().item()
        for name in ("clip_range", "clip_range_vf"):
            if getattr(self, name) is not None:
                logged[name] = self.value_of(name)
        for name, value in self.ranks.average_metrics({**metrics.summary(), **logged}).items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """Save the model; see :meth:`DistributedOnPolicyAlgorithm.save`."""
        options.note_changed_options(self)
        self.read_learning_rate()
        super().save(path, exclude, include)

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
        name = tb_log_name or type(self).__name__
        return super().learn(
            total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar
        )
