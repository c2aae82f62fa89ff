"""Evaluation of a policy in all the ways that flow policies are evaluated."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_policyflow.benchmark.measure.seeding import seeded
from sb3_policyflow.common.policies import FlowPolicy

EVALUATION_SEED = 1_000_000
"""Far from the seeds of trainings; every evaluation starts from the same states."""

STOCHASTIC, LATENT_ONLY, DETERMINISTIC = "stochastic", "latent-only", "deterministic"
MODES = {
    STOCHASTIC: "actions drawn as in training",
    LATENT_ONLY: "latents drawn, no other noise",
    DETERMINISTIC: "one action for each observation, no noise",
}
"""How a model can act, and what that means."""


def modes(model: BaseAlgorithm) -> tuple[str, ...]:
    """How a model can act: with all its randomness, with that of its latents only, with none."""
    if isinstance(model.policy, FlowPolicy):
        return tuple(MODES)
    return STOCHASTIC, DETERMINISTIC


@contextmanager
def _latents_drawn_if(model: BaseAlgorithm, mode: str) -> Iterator[None]:
    if mode != LATENT_ONLY:
        yield
        return
    assert isinstance(model.policy, FlowPolicy)
    policy = model.policy
    before, policy.deterministic_action = policy.deterministic_action, "drawn"
    try:
        yield
    finally:
        policy.deterministic_action = before


def evaluate(model: BaseAlgorithm, env: VecEnv, mode: str, n_episodes: int) -> dict[str, Any]:
    """Returns and lengths of some episodes, in environments as they are without training.

    Neither the draws of the training nor the state of its environments change.
    """
    training_env = model.get_env()
    if training_env is not None:
        sync_envs_normalization(training_env, env)
    env.seed(EVALUATION_SEED)
    with seeded(EVALUATION_SEED, model.device), _latents_drawn_if(model, mode):
        returns, lengths = evaluate_policy(
            model,
            env,
            n_eval_episodes=n_episodes,
            deterministic=mode != STOCHASTIC,
            return_episode_rewards=True,
        )
    return {
        "mode": mode,
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        "mean_length": float(np.mean(lengths)),
        "n_episodes": len(np.atleast_1d(returns)),
    }


class EvaluationCallback(BaseCallback):
    """Evaluates a model in all its modes when it has been trained for some numbers of steps.

    :param env: Environments to evaluate in.
    :param timesteps: When, in increasing order.
    :param n_episodes: Episodes of an evaluation, in each mode.
    """

    def __init__(self, env: VecEnv, timesteps: Sequence[int], n_episodes: int) -> None:
        super().__init__()
        self.env = env
        self.n_episodes = n_episodes
        self.curve: list[dict[str, Any]] = []
        self.seconds = 0.0
        self._due = list(timesteps)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        """Evaluate between updates, so that an evaluation is that of one policy."""
        self._evaluate_if_due()

    def _on_training_end(self) -> None:
        self._evaluate_if_due()

    def _evaluate_if_due(self) -> None:
        if not self._due or self.num_timesteps < self._due[0]:
            return
        self._due = [timesteps for timesteps in self._due if timesteps > self.num_timesteps]
        start = time.perf_counter()
        for mode in modes(self.model):
            evaluation = evaluate(self.model, self.env, mode, self.n_episodes)
            self.curve.append({"timesteps": self.num_timesteps, **evaluation})
        self.seconds += time.perf_counter() - start
