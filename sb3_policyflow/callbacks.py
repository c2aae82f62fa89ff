"""A callback that measures how good the approximations of PolicyFlow's update are."""

import warnings
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import torch as th
from numpy.typing import ArrayLike
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.common.checks import at_least
from sb3_policyflow.common.entropy import action_entropy
from sb3_policyflow.common.losses import gaussian_kl, shifted_gaussian_log_ratio
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.policies import FlowPolicy as BaseFlowPolicy
from sb3_policyflow.common.tree import rows
from sb3_policyflow.flows import TIME_SAMPLERS
from sb3_policyflow.policyflow import PolicyFlow, PolicyFlowPolicy
from sb3_policyflow.resilience.saving import preserve_rng_state


class Shifts(NamedTuple):
    """Shifts of the end points of n latents by an update, each of shape (n, action_dim).

    ``exact`` integrates the flow with both policies. ``approximate`` is the paper's approximation:
    the change of the velocity at points between latent and old end point, averaged over the
    solver's times. ``sampled`` is the same average over the times that the algorithm draws: what
    its loss uses with one time, or with ``time_average="shift"``.
    """

    exact: th.Tensor
    approximate: th.Tensor
    sampled: th.Tensor


class FlowDiagnosticsCallback(BaseCallback):
    """Compares the paper's importance ratio with the exact one, on a sample of the rollout.

    The flow is integrated with the parameters before and after the update. Given the latent, the
    exact log ratio of an action is log N(a; phi', sigma'^2) - log N(a; phi, sigma^2). The paper
    approximates phi' - phi by the change of the velocity. These metrics are logged under
    ``diagnostics/`` with the next rollout, or at the end of the training:

    - ``log_ratio_correlation`` and ``log_ratio_error``: Pearson's correlation and the root mean
      squared difference of the approximate and the exact log ratio. With ``_sampled`` at the end of
      the name, the same for the times that the algorithm draws.
    - ``log_ratio_exact_std``: standard deviation of the exact log ratio, as a scale for the error.
    - ``shift_exact`` and ``shift_approximate``: mean length of the end point's shift;
      ``shift_error``: mean length of their difference; ``shift_cosine``: cosine between them.
    - ``kl_exact``: KL divergence of the policies given the latent, in nats, from the exact shift.
    - ``action_entropy``: entropy of the actions in nats, estimated from nearest neighbors and
      averaged over states.

    - ``return_drawn`` and ``return_deterministic``, if there is an ``eval_env``: mean returns of
      episodes with actions drawn as in training and of deterministic ones. Where the latter are
      much less, a warning says so, once.

    The callback does not change the training. For algorithms other than PolicyFlow only the entropy
    is logged.

    :param every: Number of rollouts from one measurement to the next.
    :param n_samples: Number of transitions of the rollout to measure. The cost is that of
        integrating as many flows twice.
    :param n_entropy_states: Number of states in which the entropy of actions is estimated; 0 for
        none.
    :param n_entropy_actions: Number of actions drawn in each of these states, at least 2.
    :param verbose: See SB3.
    :param eval_env: Environments, other than those of the training, in which to compare the returns
        of drawn and deterministic actions.
    :param n_eval_episodes: Episodes of each.
    :raises ValueError: If a number is too small.
    """

    def __init__(
        self,
        every: int = 1,
        n_samples: int = 1024,
        n_entropy_states: int = 16,
        n_entropy_actions: int = 64,
        verbose: int = 0,
        eval_env: VecEnv | None = None,
        n_eval_episodes: int = 10,
    ) -> None:
        super().__init__(verbose)
        at_least(1)("every", every)
        at_least(2)("n_eval_episodes", n_eval_episodes)
        at_least(2)("n_samples", n_samples)
        at_least(0)("n_entropy_states", n_entropy_states)
        at_least(2)("n_entropy_actions", n_entropy_actions)
        self.every = every
        self.n_samples = n_samples
        self.n_entropy_states = n_entropy_states
        self.n_entropy_actions = n_entropy_actions
        self.eval_env = eval_env
        self.n_eval_episodes = n_eval_episodes
        self.n_rollouts = 0
        self._has_warned = False
        self._before: tuple[BaseFlowPolicy, FlowRolloutBufferSamples] | None = None

    def _init_callback(self) -> None:
        if not isinstance(self.model, FlowOnPolicyAlgorithm):
            raise ValueError(
                "FlowDiagnosticsCallback looks at flow policies, such as PolicyFlow's, not at "
                f"{type(self.model).__name__}: leave it out."
            )
        self.algorithm = self.model

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        """Copy the policy and a sample of the rollout, before the update changes the policy."""
        self.n_rollouts += 1
        if self.n_rollouts % self.every == 0:
            with preserve_rng_state(self.model.device), th.no_grad():
                self._before = deepcopy(self.algorithm.policy), self._sample()

    def _sample(self) -> FlowRolloutBufferSamples:
        samples = self.algorithm.rollout_buffer.samples()
        chosen = th.randperm(len(samples.actions), device="cpu")[: self.n_samples]
        return rows(samples, chosen.to(samples.actions.device))

    def _on_rollout_start(self) -> None:
        if self._before is not None:
            self._measure()

    def _on_training_end(self) -> None:
        if self._before is not None:
            self._measure()
            # SB3 writes the log after a rollout, and there is none to come.
            self.logger.record("time/total_timesteps", self.num_timesteps)
            self.logger.dump(self.num_timesteps)

    def _measure(self) -> None:
        """Compare the policy with the copy from before the update."""
        assert self._before is not None
        (old, samples), self._before = self._before, None
        new = self.algorithm.policy
        new.set_training_mode(False)
        with preserve_rng_state(self.model.device), th.no_grad():
            metrics = {}
            if isinstance(old, PolicyFlowPolicy) and isinstance(new, PolicyFlowPolicy):
                metrics = self._compare(old, new, samples)
            if self.n_entropy_states > 0:
                metrics["action_entropy"] = self._entropy(new, samples.observations)
            if self.eval_env is not None:
                metrics |= self._returns(self.eval_env)
        for name, value in metrics.items():
            self.logger.record(f"diagnostics/{name}", value.item())

    def _compare(
        self, old: PolicyFlowPolicy, new: PolicyFlowPolicy, samples: FlowRolloutBufferSamples
    ) -> dict[str, th.Tensor]:
        shifts = end_point_shifts(old, new, samples, self._draw_times(samples))
        noise = samples.actions - samples.record.endpoints
        log_stds = new.noise_log_std, old.noise_log_std
        exact, approximate, sampled = (
            shifted_gaussian_log_ratio(noise, shift, *log_stds) for shift in shifts
        )
        return {
            "log_ratio_correlation": _correlation(approximate, exact),
            "log_ratio_error": _rms(approximate - exact),
            "log_ratio_correlation_sampled": _correlation(sampled, exact),
            "log_ratio_error_sampled": _rms(sampled - exact),
            "log_ratio_exact_std": exact.std(),
            "shift_exact": shifts.exact.norm(dim=-1).mean(),
            "shift_approximate": shifts.approximate.norm(dim=-1).mean(),
            "shift_error": (shifts.approximate - shifts.exact).norm(dim=-1).mean(),
            "shift_cosine": th.cosine_similarity(shifts.approximate, shifts.exact).mean(),
            "kl_exact": gaussian_kl(shifts.exact, *log_stds).mean(),
        }

    def _returns(self, env: VecEnv) -> dict[str, th.Tensor]:
        """Mean returns of drawn and of deterministic actions."""
        training_env = self.model.get_env()
        if training_env is not None:
            sync_envs_normalization(training_env, env)
        drawn, deterministic = (
            evaluate_policy(
                self.model,
                env,
                n_eval_episodes=self.n_eval_episodes,
                deterministic=is_deterministic,
                return_episode_rewards=True,
            )[0]
            for is_deterministic in (False, True)
        )
        if not self._has_warned:
            self._has_warned = warn_of_deterministic_actions(
                drawn, deterministic, "act and evaluate with deterministic=False"
            )
        means = {"return_drawn": drawn, "return_deterministic": deterministic}
        return {name: th.as_tensor(np.mean(values)) for name, values in means.items()}

    def _draw_times(self, samples: FlowRolloutBufferSamples) -> th.Tensor:
        """Draw times as the algorithm does, shape (n, n_times)."""
        model = self.algorithm
        assert isinstance(model, PolicyFlow)
        times = TIME_SAMPLERS[model.time_sampler](model.policy.flow.times())
        return times.sample(len(samples.actions), model.n_times)

    def _entropy(self, policy: BaseFlowPolicy, observations: PyTorchObs) -> th.Tensor:
        """Entropy of the actions in nats, averaged over states."""
        some = rows(observations, slice(self.n_entropy_states))
        return action_entropy(policy, policy.actor_features(some), self.n_entropy_actions)


def warn_of_deterministic_actions(drawn: ArrayLike, deterministic: ArrayLike, advice: str) -> bool:
    """Warn if deterministic actions return much less than drawn ones.

    Much less is a quarter of the greater return, and three standard errors.

    :param drawn: Returns of episodes with actions drawn as in training, shape (n,).
    :param deterministic: Returns of episodes with deterministic actions, shape (m,).
    :param advice: What to do then.
    :return: Whether there was something to warn of.
    """
    returns = [np.asarray(values, dtype=np.float64) for values in (drawn, deterministic)]
    if min(map(len, returns)) < 2:
        return False
    (high, low), errors = [r.mean() for r in returns], [r.var(ddof=1) / len(r) for r in returns]
    if high - low <= max(0.25 * max(abs(high), abs(low)), 3 * np.sqrt(sum(errors))):
        return False
    warnings.warn(
        f"Deterministic actions return {low:.4g} and drawn ones {high:.4g}: one action for "
        f"each observation may be too few for this policy. To see what was learned, {advice}.",
        stacklevel=2,
    )
    return True


def end_point_shifts(
    old: PolicyFlowPolicy,
    new: PolicyFlowPolicy,
    samples: FlowRolloutBufferSamples,
    times: th.Tensor,
) -> Shifts:
    """Shifts of the flow's end points from one policy to another.

    :param old: The policy that collected the samples.
    :param new: The policy after an update.
    :param samples: n transitions with PolicyFlow's record of latents and end points.
    :param times: Times for ``Shifts.sampled``, shape (n, k).
    :return: The exact, approximate and sampled shifts.
    """
    latents = samples.record.latents
    features = {policy: policy.actor_features(samples.observations) for policy in (old, new)}
    exact = new.transport(latents, features[new]) - old.transport(latents, features[old])
    grid = old.flow.times().expand(len(latents), -1)

    def mean_change(at: th.Tensor) -> th.Tensor:
        ends = samples.record.endpoints.unsqueeze(1)
        points = old.flow.interpolant.interpolate(latents.unsqueeze(1), ends, at)
        after, before = (
            policy.velocity(points, at, features[policy].unsqueeze(1)) for policy in (new, old)
        )
        change: th.Tensor = old.flow.interpolant.end_time * (after - before).mean(dim=1)
        return change

    return Shifts(exact, mean_change(grid), mean_change(times))


def _rms(values: th.Tensor) -> th.Tensor:
    return values.square().mean().sqrt()


def _correlation(one: th.Tensor, other: th.Tensor) -> th.Tensor:
    """Pearson's correlation of two tensors (n,); NaN if one of them is constant."""
    return th.corrcoef(th.stack([one, other]))[0, 1]
