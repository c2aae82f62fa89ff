"""An on-policy algorithm of SB3 whose rates and coefficients may change as it learns."""

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_policyflow.common.policies import FlowPolicy
from sb3_policyflow.common.schedules import (
    Coefficient,
    KLAdaptiveLearningRate,
    parse_schedule,
)
from sb3_policyflow.distributed.ranks import Ranks


class ScheduledOnPolicyAlgorithm(OnPolicyAlgorithm):
    """SB3's ``OnPolicyAlgorithm`` with rates and coefficients that may change at any time.

    Every option that may be a schedule is read by :meth:`value_of`. With ``desired_kl`` the
    learning rate follows the divergence of the policy, from ``learning_rate`` on.
    """

    desired_kl: Coefficient | None
    critic_learning_rate: Coefficient | None
    adaptive_learning_rate: float | None = None
    """The present learning rate with ``desired_kl``, None without it."""
    policy: FlowPolicy
    ranks: Ranks
    """The processes that train this model."""
    _adaptive_start: float | None = None  # the learning rate that the adaptive one started with
    _learning_rates: tuple[object, Schedule]  # the rate, and the schedule that was made of it

    def value_of(self, name: str) -> float:
        """The value of an option that may be a schedule, at the present progress.

        :param name: The option, such as "ent_coef".
        """
        schedule = parse_schedule(name, getattr(self, name))
        return float(schedule(self._current_progress_remaining))

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last rollout may end beyond total_timesteps, where SB3's value is negative and a
        # linear schedule with it: a negative learning rate would ascend the loss.
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = parse_schedule("learning_rate", self.learning_rate)
        self._learning_rates = self.learning_rate, self.lr_schedule

    def read_learning_rate(self) -> None:
        """Take up a ``learning_rate`` or ``lr_schedule`` that has been set."""
        learning_rate, schedule = self._learning_rates
        if self.lr_schedule is not schedule:
            self.learning_rate = self.lr_schedule
        if self.learning_rate is not learning_rate:
            self._setup_lr_schedule()

    def critic_learning_rate_now(self) -> float | None:
        """The present learning rate of the critic's own parameters; None for that of the actor."""
        return None if self.critic_learning_rate is None else self.value_of("critic_learning_rate")

    def _start_adaptive_learning_rate(self) -> None:
        """Start with ``learning_rate``, unless a run continues that started with it."""
        start = self.lr_schedule(1.0)
        if self.desired_kl is None:
            self.adaptive_learning_rate = None
        elif self.adaptive_learning_rate is None or start != self._adaptive_start:
            self.adaptive_learning_rate = start
        self._adaptive_start = start

    def _update_learning_rate(
        self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer
    ) -> None:
        self._start_adaptive_learning_rate()
        if (rate := self.critic_learning_rate_now()) is not None:
            self.logger.record("train/critic_learning_rate", rate)
        if self.adaptive_learning_rate is None:
            super()._update_learning_rate(optimizers)
            return
        self.logger.record("train/learning_rate", self.adaptive_learning_rate)
        update_learning_rate(self.policy.optimizer, self.adaptive_learning_rate)

    def _adapt_learning_rate(
        self, rule: KLAdaptiveLearningRate, kls: list[th.Tensor], trains_actor: bool
    ) -> None:
        """Move the learning rate, if it is adaptive.

        :param rule: How it moves.
        :param kls: Divergences whose mean, over the ranks too, it follows.
        :param trains_actor: Whether the actor learns; else there is no reason to learn faster.
        """
        if self.adaptive_learning_rate is None or not trains_actor:
            return
        kl = self.ranks.mean(th.stack(kls).mean())
        rate = rule.adapt(self.adaptive_learning_rate, kl, self.value_of("desired_kl"))
        self.adaptive_learning_rate = rate
        update_learning_rate(self.policy.optimizer, rate)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_learning_rates"]
