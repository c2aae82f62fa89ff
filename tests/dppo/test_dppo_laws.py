"""Laws of DPPO's objective."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.envs import FakeImageEnv
from torch.distributions import Normal

from sb3_policyflow import DPPO
from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.update import UpdateMetrics
from sb3_policyflow.dppo.dppo import DPPOUpdate
from sb3_policyflow.dppo.policies import DPPORecord
from tests.helpers import collected, perturb

N_SAMPLES = 64


def terms(model: DPPO, batch: FlowRolloutBufferSamples) -> Any:
    features = model.policy.actor_features(batch.observations)
    return DPPOUpdate(model, batch).terms(batch, features)


@pytest.mark.parametrize("process", ["ddpm", "flow"])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_log_ratios_are_zero_at_equal_weights(process: str, reduction: str) -> None:
    model, rollout = collected(DPPO, process=process, log_prob_reduction=reduction)
    for batch in model.rollout_buffer.minibatches(rollout, 16):
        result = terms(model, batch)
        assert result.log_ratio.shape == (16, 10)
        th.testing.assert_close(result.log_ratio, th.zeros(16, 10), atol=2e-4, rtol=0)
        assert result.kl.item() < 1e-8


@pytest.mark.parametrize("process", ["ddpm", "flow"])
def test_log_prob_of_the_chain_is_that_of_its_gaussians(process: str) -> None:
    model, rollout = collected(DPPO, process=process, log_prob_clamp=None, log_prob_reduction="sum")
    record: DPPORecord = rollout.record
    perturb(model.policy.velocity, 0.02)
    policy = model.policy
    with th.no_grad():
        features = policy.actor_features(rollout.observations)
        means = policy.trained_means(record.points[:, :-1], features)
        expected = th.zeros(N_SAMPLES)
        for step in range(10):
            points = record.points[:, step]
            outputs = policy.velocity(points, th.tensor(step / 10), features)
            mean = policy.chain.means(points, outputs, step)
            std = max(policy.chain.stds[step].item(), 0.1)
            expected += Normal(mean, std).log_prob(record.points[:, step + 1]).sum(-1)
    log_probs = DPPOUpdate(model, rollout).log_probs(record, means)
    th.testing.assert_close(log_probs.sum(-1), expected, atol=1e-3, rtol=1e-4)
    old = DPPOUpdate(model, rollout).log_probs(record, record.means)
    th.testing.assert_close(terms(model, rollout).log_ratio, log_probs - old)


def test_one_step_is_a_gaussian_policy_at_the_floor_std() -> None:
    options = {"n_denoising_steps": 1, "log_prob_clamp": None, "log_prob_reduction": "sum"}
    model, rollout = collected(DPPO, min_sampling_std=0.3, min_log_prob_std=0.3, **options)
    record: DPPORecord = rollout.record
    assert model.policy.chain.stds.tolist() == [0.0]
    noise = record.points[:, 1] - record.means[:, 0]
    assert noise.std().item() == pytest.approx(0.3, rel=0.25)
    th.testing.assert_close(rollout.actions, record.points[:, 1].clamp(-1, 1))
    perturb(model.policy.velocity, 0.02)
    with th.no_grad():
        features = model.policy.actor_features(rollout.observations)
        means = model.policy.trained_means(record.points[:, :1], features)[:, 0]
    new, old = Normal(means, 0.3), Normal(record.means[:, 0], 0.3)
    action = record.points[:, 1]
    expected = (new.log_prob(action) - old.log_prob(action)).sum(-1)
    th.testing.assert_close(terms(model, rollout).log_ratio[:, 0], expected, atol=1e-4, rtol=1e-4)


def test_divergence_is_that_of_the_steps() -> None:
    model, rollout = collected(DPPO)
    perturb(model.policy.velocity, 0.02)
    record, policy = rollout.record, model.policy
    with th.no_grad():
        features = policy.actor_features(rollout.observations)
        means = policy.trained_means(record.points[:, :-1], features)
    stds = policy.log_prob_stds.unsqueeze(-1)
    divergence = th.distributions.kl_divergence(Normal(record.means, stds), Normal(means, stds))
    th.testing.assert_close(terms(model, rollout).kl, divergence.sum((1, 2)).mean())


def test_log_probs_are_clamped_before_they_are_reduced() -> None:
    model, rollout = collected(DPPO, process="flow", n_denoising_steps=1)
    means = th.zeros(1, 1, 2)
    points = th.stack([th.zeros(1, 2), th.tensor([[0.0, 9.0]])], dim=1)
    # log N(0; 0, 0.1^2) = 1.38 stays, that of 9 is far below -5.
    record = DPPORecord(points, means)
    expected = (Normal(0.0, 0.1).log_prob(th.tensor(0.0)).item() - 5) / 2
    assert DPPOUpdate(model, rollout).log_probs(record, means).item() == pytest.approx(
        expected, rel=1e-5
    )


def test_later_steps_weigh_more_and_are_clipped_later() -> None:
    model, rollout = collected(
        DPPO, denoising_gamma=0.5, clip_range_base=0.01, clip_range=0.2, n_denoising_steps=3
    )
    update = DPPOUpdate(model, rollout)
    clip_ranges = update.clip_range
    assert isinstance(clip_ranges, th.Tensor)
    middle = 0.01 + 0.19 * (np.exp(1.5) - 1) / (np.exp(3) - 1)
    th.testing.assert_close(clip_ranges, th.tensor([0.01, middle, 0.2], dtype=th.float32))
    loss = update.surrogate_loss(th.full((1, 3), 5.0), th.tensor([2.0]), UpdateMetrics())
    expected = 2 * (0.25 * 1.01 + 0.5 * (1 + middle) + 1.2) / 3
    assert loss.item() == pytest.approx(-expected)


def test_a_single_step_has_the_last_clip_range() -> None:
    model, rollout = collected(DPPO, clip_range_base=0.01, n_denoising_steps=1)
    assert float(DPPOUpdate(model, rollout).clip_range) == pytest.approx(0.2)


def test_only_the_last_steps_are_trained() -> None:
    model, rollout = collected(DPPO, n_finetuned_steps=4)
    assert rollout.record.means.shape == (N_SAMPLES, 4, 1)
    frozen = [value.clone() for value in model.policy.base_velocity.state_dict().values()]
    model.train()
    base, trained = model.policy.base_velocity.state_dict(), model.policy.velocity.state_dict()
    assert all(th.equal(old, new) for old, new in zip(frozen, base.values(), strict=True))
    assert not th.equal(base["output.weight"], trained["output.weight"])
    model.policy.freeze_base()
    base = model.policy.base_velocity.state_dict()
    assert th.equal(base["output.weight"], trained["output.weight"])


def image_model(**options: Any) -> DPPO:
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    policy_kwargs = {"initialization": "glorot", **options.pop("policy_kwargs", {})}
    sizes = {"n_steps": 32, "batch_size": 16, "n_epochs": 4, "learning_rate": 1e-3}
    return DPPO("CnnPolicy", env, policy_kwargs=policy_kwargs, seed=0, **sizes, **options)


def test_frozen_steps_do_not_follow_the_extractor() -> None:
    model = image_model(n_finetuned_steps=2)
    obs = model.policy.obs_to_tensor(model.env.reset())[0]  # type: ignore[union-attr]

    def means() -> tuple[th.Tensor, th.Tensor]:
        with th.no_grad():
            features = model.policy.actor_features(obs)
            points = th.zeros(1, model.policy.action_dim)  # where no bound hides a change
            first, last = (model.policy.step_means(points, step, features) for step in (7, 8))
        return first, last

    (frozen, trained), _ = means(), model.learn(3 * 32)
    assert th.equal(means()[0], frozen)
    assert not th.equal(means()[1], trained)
    model.policy.freeze_base()
    assert not th.equal(means()[0], frozen)


def test_untrained_policy_stays_off_the_bounds_with_the_identity_skip() -> None:
    shares = []
    for identity_skip in (True, False):
        model = DPPO("MlpPolicy", "Pendulum-v1", identity_skip=identity_skip, seed=0)
        with th.no_grad():
            actions, _ = model.policy.sample_actions(th.randn(1000, 3))
        shares.append((actions.abs() == 1).float().mean().item())
    assert shares[0] < 0.05
    assert shares[1] > 0.15


class Lopsided(gym.Env[Any, Any]):
    """Takes actions between 3 and 11."""

    observation_space = spaces.Box(-1.0, 1.0, (1,))
    action_space = spaces.Box(3.0, 11.0, (2,))

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        self.seen.append(action)
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {}


def test_ddpm_scales_its_actions_to_their_space() -> None:
    env = Lopsided()
    model = DPPO("MlpPolicy", env, n_steps=128, batch_size=64).learn(128)
    seen = np.stack(env.seen)
    assert seen.min() >= 3
    assert seen.max() <= 11
    assert seen.mean() == pytest.approx(7, abs=1)
    assert np.abs(model.rollout_buffer.actions).max() <= 1
