"""Arguments of the flow algorithms: what there is, what is refused, what changes over time."""

import math
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate

from sb3_policyflow.common import checks
from sb3_policyflow.common.buffers import DictFlowRolloutBuffer, FlowRolloutBuffer
from sb3_policyflow.common.learning_rate import KLAdaptiveLearningRate
from sb3_policyflow.common.policies import FlowActorCriticPolicy, check_flow_spaces
from sb3_policyflow.common.schedules import Coefficient, parse_schedule
from sb3_policyflow.resilience.collection import CollectionMixin
from sb3_policyflow.resilience.saving import SavingMixin


class FlowAlgorithmArguments(SavingMixin, CollectionMixin):
    """An on-policy algorithm for flow policies, up to its update.

    Takes the arguments of SB3's PPO, in its order and with its meanings, except that gSDE is not
    supported, ``max_grad_norm`` may be None or not positive for no clipping, and ``ent_coef`` may
    be a schedule; and:

    :param desired_kl: Target of the KL-adaptive learning rate, which starts at ``learning_rate``:
        a constant, "lin_START", "lin_START_END" or a function of the remaining progress; None to
        keep to ``learning_rate``.
    :param lr_adaptation: When the adaptive learning rate moves: after each "epoch" or "minibatch".
    :param lr_factor: By how much it moves.
    :param lr_bounds: Its lowest and highest value; if it starts beyond, it only ever comes nearer.
    :param kl_margin: How far off ``desired_kl`` the divergence may be before it moves.
    :param kl_window: Mean of which divergences it follows at the end of an epoch: those of the
        "epoch", or all since the start of the "update".
    :param advantage_scope: Where advantages are normalized: in each "minibatch", as SB3 does, or
        over the whole "rollout".
    :param timeout_bootstrap: The value that an episode cut by a time limit goes on with: that of
        the "terminal" observation, as in SB3, of the "current" one before it, or "none".
    :raises ValueError: If an argument cannot be used.
    """

    policy_base: ClassVar[type[FlowActorCriticPolicy]]
    policy_arguments: ClassVar[tuple[str, ...]] = ()
    """Arguments of the algorithm that it hands on to its policy."""

    policy: FlowActorCriticPolicy
    rollout_buffer: FlowRolloutBuffer | DictFlowRolloutBuffer

    def __init__(
        self,
        policy: str | type[FlowActorCriticPolicy],
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
        lr_adaptation: str = "epoch",
        lr_factor: float = 1.5,
        lr_bounds: tuple[float, float] = (1e-6, 1e-2),
        kl_margin: float = 2.0,
        kl_window: str = "epoch",
        advantage_scope: str = "minibatch",
        timeout_bootstrap: str = "terminal",
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,  # type: ignore[arg-type]  # may be a schedule here
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,  # type: ignore[arg-type]  # None turns clipping off
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
            _init_setup_model=False,
        )
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.clip_range = clip_range
        self.clip_range_vf = clip_range_vf
        self.normalize_advantage = normalize_advantage
        self.target_kl = target_kl
        self.desired_kl = desired_kl
        self.lr_adaptation = lr_adaptation
        self.lr_factor = lr_factor
        self.lr_bounds = lr_bounds
        self.kl_margin = kl_margin
        self.kl_window = kl_window
        self.advantage_scope = advantage_scope
        self.timeout_bootstrap = timeout_bootstrap
        self.adaptive_learning_rate: float | None = None
        self._adaptive_start: float | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()
        self.rollout_buffer_class = checks.choose_buffer_class(
            type(self).__name__, self.rollout_buffer_class, self.observation_space
        )
        own_policy_kwargs = self.policy_kwargs
        self.policy_kwargs = self._complete_policy_kwargs()
        super()._setup_model()
        self.policy_kwargs = own_policy_kwargs
        self._setup_schedules()

    def _check_arguments(self) -> None:
        """Refuse what cannot be used, before networks and buffers are made."""
        space = getattr(self, "observation_space", None)
        checks.check_environment(type(self).__name__, self.env, space)
        check_flow_spaces(self.action_space, self.use_sde)
        checks.check_policy_class(type(self).__name__, self.policy_class, self.policy_base)
        for name in ("learning_rate", "clip_range", "vf_coef"):
            checks.check_between(name, getattr(self, name), 0.0)
        for name in ("gamma", "gae_lambda"):
            checks.check_between(name, getattr(self, name), 0.0, 1.0)
        checks.check_positive_or_none("target_kl", self.target_kl)
        if self.max_grad_norm is not None:
            checks.check_between("max_grad_norm", self.max_grad_norm, -math.inf)
        if not callable(self.clip_range_vf):
            checks.check_positive_or_none("clip_range_vf", self.clip_range_vf)
        checks.check_count("n_steps", self.n_steps, 1)
        checks.check_count("n_epochs", self.n_epochs, 1)
        checks.check_batches(self.batch_size, self.n_steps, self.n_envs, self.normalize_advantage)
        checks.check_choice("lr_adaptation", self.lr_adaptation, ("epoch", "minibatch"))
        checks.check_choice("kl_window", self.kl_window, ("epoch", "update"))
        checks.check_choice("advantage_scope", self.advantage_scope, ("minibatch", "rollout"))
        checks.check_choice(
            "timeout_bootstrap", self.timeout_bootstrap, ("terminal", "current", "none")
        )

    def _complete_policy_kwargs(self) -> dict[str, Any]:
        """The user's ``policy_kwargs`` with what the algorithm's own arguments add to them."""
        twice = [name for name in self.policy_arguments if name in self.policy_kwargs]
        if twice:
            raise ValueError(f"Give {twice} to {type(self).__name__} itself, not in policy_kwargs.")
        own = {name: getattr(self, name) for name in self.policy_arguments}
        return {**self.policy_kwargs, **own}

    def _setup_schedules(self) -> None:
        """Turn coefficients into functions of the remaining progress."""
        self.clip_range = FloatSchedule(self.clip_range)
        if self.clip_range_vf is not None:
            self.clip_range_vf = FloatSchedule(self.clip_range_vf)
        self._entropy_schedule = parse_schedule("ent_coef", self.ent_coef)
        self._lr_rule = KLAdaptiveLearningRate(self.lr_factor, self.kl_margin, self.lr_bounds)
        if self.desired_kl is not None:
            self._kl_schedule = parse_schedule("desired_kl", self.desired_kl)
            if self._kl_schedule(1.0) == 0:
                raise ValueError(f"desired_kl must be positive or None, got {self.desired_kl}.")
        self._start_adaptive_learning_rate()

    def _start_adaptive_learning_rate(self) -> None:
        """Begin with ``learning_rate``, unless a saved run that began with it goes on.

        :raises ValueError: If ``learning_rate`` is a schedule, which nothing would follow.
        """
        start = self.lr_schedule(1.0)
        if self.desired_kl is None:
            self.adaptive_learning_rate = None
        elif start != self.lr_schedule(0.0):
            raise ValueError(
                "With desired_kl the learning rate follows the divergence of the policy: give the "
                "learning_rate that it starts with, not a schedule."
            )
        elif self.adaptive_learning_rate is None or self._adaptive_start != start:
            self.adaptive_learning_rate = start
        self._adaptive_start = start

    def _excluded_save_params(self) -> list[str]:
        derived = ["_entropy_schedule", "_kl_schedule", "_lr_rule"]
        return [*super()._excluded_save_params(), *derived]

    def _now(self, schedule: Any) -> float:
        """A schedule's value at the present progress."""
        return float(schedule(self._current_progress_remaining))

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last rollout may end beyond total_timesteps, where SB3's figure is negative, and with
        # it a linear schedule: a learning rate that climbs the loss.
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)

    def _update_learning_rate(
        self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer
    ) -> None:
        if self.adaptive_learning_rate is None:
            super()._update_learning_rate(optimizers)
            return
        self.logger.record("train/learning_rate", self.adaptive_learning_rate)
        update_learning_rate(self.policy.optimizer, self.adaptive_learning_rate)

    def _adapt_learning_rate(self, divergences: list[th.Tensor]) -> None:
        """Move the learning rate after the mean of some divergences, if it is adaptive."""
        if self.adaptive_learning_rate is None:
            return
        kl = th.stack(divergences).mean().item()
        self.adaptive_learning_rate = self._lr_rule.adapt(
            self.adaptive_learning_rate, kl, self._now(self._kl_schedule)
        )
        update_learning_rate(self.policy.optimizer, self.adaptive_learning_rate)
