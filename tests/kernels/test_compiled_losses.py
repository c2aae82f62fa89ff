"""The compiled loss of PolicyFlow is that of its formulas, and so are its gradients."""

from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_policyflow import PolicyFlow
from sb3_policyflow.common.update import UpdateMetrics
from sb3_policyflow.kernels import threads
from sb3_policyflow.kernels.losses import EvaluatedLoss
from sb3_policyflow.policyflow.compiled import make_compiled_loss
from sb3_policyflow.policyflow.policyflow import PolicyFlowUpdate
from tests.helpers import collected, learned, perturb, train

CASES: dict[str, dict[str, Any]] = {
    "defaults": {},
    "regularizers": {"brownian_coef": 0.3, "ent_coef": 0.1, "clip_range_vf": 0.1, "vf_coef": 2.0},
    "several times": {"n_times": 3, "time_sampler": "uniform", "brownian_coef": 0.1},
    "mean shift": {"n_times": 3, "time_average": "shift", "brownian_reduction": "mean"},
    "more times than a block has rows": {"n_times": 70, "time_average": "shift"},
    "clamped ratios": {"log_ratio_clamp": 0.05, "clip_range": 0.02},
    "narrow latents": {"latent_std": 0.3, "brownian_coef": 0.2},
    "trigflow": {"interpolant": "trigflow", "brownian_coef": 0.2, "brownian_reduction": "mean"},
    "noise within bounds": {"log_std_bounds": (-1.0, 0.5), "ent_coef": 0.1},
    "stochastic": {"interpolant": "stochastic", "brownian_coef": 0.2},
}


def prepared(**options: Any) -> tuple[Any, PolicyFlowUpdate, Any]:
    """A model whose policy has moved since its update began, the update, and a minibatch."""
    model, rollout = collected(PolicyFlow, **options)
    update = PolicyFlowUpdate(model, rollout)
    perturb(model.policy, 0.05)
    model.policy.keep_within_bounds()
    return model, update, rollout._replace(drawn=update.draw())


def evaluated(model: Any, update: Any, batch: Any) -> tuple[float, float, Any, list[th.Tensor]]:
    """Loss, divergence, metrics and gradients."""
    metrics = UpdateMetrics()
    model.policy.zero_grad()
    loss, kl = update.loss(batch, metrics)
    loss.backward()
    return loss.item(), kl.item(), metrics.summary(), [p.grad for p in learned(model.policy)]


def assert_close(compiled: Any, plain: Any) -> None:
    assert compiled[0] == pytest.approx(plain[0], rel=1e-4, abs=1e-5)
    assert compiled[1] == pytest.approx(plain[1], rel=1e-4, abs=1e-6)
    assert compiled[2] == pytest.approx(plain[2], rel=1e-4, abs=1e-5)
    for ours, theirs in zip(compiled[3], plain[3], strict=True):
        scale = theirs.abs().max().item()
        th.testing.assert_close(ours, theirs, rtol=0, atol=1e-4 * scale + 1e-6)


@pytest.mark.parametrize("case", CASES)
def test_loss_metrics_and_gradients(case: str) -> None:
    model, update, batch = prepared(**CASES[case])
    assert isinstance(update.loss(batch, UpdateMetrics())[0], EvaluatedLoss)
    compiled = evaluated(model, update, batch)
    update.compiled_loss = None
    assert_close(compiled, evaluated(model, update, batch))


def test_latents_that_differ_between_dimensions(monkeypatch: pytest.MonkeyPatch) -> None:
    model, rollout = collected(PolicyFlow, brownian_coef=0.2)
    monkeypatch.setattr(type(model.policy), "latent_scale", th.tensor([0.7]))
    update = PolicyFlowUpdate(model, rollout)
    batch = rollout._replace(drawn=update.draw())
    compiled = evaluated(model, update, batch)
    update.compiled_loss = None
    assert_close(compiled, evaluated(model, update, batch))


def test_gradients_go_on_to_a_features_extractor() -> None:
    model, update, batch = prepared()
    layer = nn.Linear(3, 3)
    extract = model.policy.actor_critic_features

    def features(observations: Any) -> tuple[th.Tensor, th.Tensor]:
        return layer(extract(observations)[0]), layer(2 * extract(observations)[1])

    model.policy.actor_critic_features = features
    found = []
    for _ in range(2):
        layer.zero_grad()
        compiled = evaluated(model, update, batch)
        found.append((*compiled[:3], [*compiled[3], *[p.grad for p in layer.parameters()]]))
        update.compiled_loss = None
    assert_close(*found)


def test_gradients_of_some_parameters_only() -> None:
    model, update, batch = prepared()
    model.policy.zero_grad()
    critic = list(model.policy.critic_parameters())
    update.loss(batch, UpdateMetrics())[0].backward(inputs=critic)
    with_gradients = {p for p in model.policy.parameters() if p.grad is not None}
    assert with_gradients == set(critic)


def test_gradients_add_up_and_frozen_parameters_have_none() -> None:
    model, update, batch = prepared()
    model.policy.velocity.output.bias.requires_grad_(False)
    model.policy.zero_grad()
    update.loss(batch, UpdateMetrics())[0].backward()
    once = model.policy.value_net.bias.grad.clone()
    update.loss(batch, UpdateMetrics())[0].backward()
    th.testing.assert_close(model.policy.value_net.bias.grad, 2 * once)
    assert model.policy.velocity.output.bias.grad is None


def with_subclass(model: Any, monkeypatch: Any) -> None:
    class Mine(PolicyFlowUpdate):
        """A user's own update."""

    monkeypatch.setattr(type(model), "update_class", Mine)


def with_trust_region(model: Any, _: Any) -> None:
    model.trust_region = "spo"


def with_hook(model: Any, _: Any) -> None:
    model.policy.value_net.weight.register_hook(lambda gradient: gradient)


def with_module_hook(model: Any, _: Any) -> None:
    model.policy.velocity.register_forward_hook(lambda *_: None)


def with_uniform_targets(model: Any, _: Any) -> None:
    model.uniform_noise_coef = 0.1


@pytest.mark.parametrize(
    "change",
    [with_subclass, with_trust_region, with_hook, with_module_hook, with_uniform_targets],
)
def test_what_no_kernel_knows_is_left_to_the_formulas(
    change: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, rollout = collected(PolicyFlow)
    change(model, monkeypatch)
    update = model.update_class(model, rollout)
    loss, _ = update.loss(rollout._replace(drawn=update.draw()), UpdateMetrics())
    assert isinstance(loss, th.Tensor)


@pytest.mark.parametrize("options", [{}, {"n_times": 3, "time_average": "shift"}])
def test_threads_change_nothing_but_rounding(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, update, batch = prepared(**options)
    monkeypatch.setattr(threads, "MIN_FLOPS_PER_THREAD", 1)
    monkeypatch.setattr(threads, "n_usable_threads", lambda: 1)
    one = evaluated(model, update, batch)
    monkeypatch.setattr(threads, "n_usable_threads", lambda: 3)
    three = evaluated(model, update, batch)
    assert_close(three, one)
    again = evaluated(model, update, batch)
    assert all(map(th.equal, again[3], three[3]))


OPTIMIZERS: dict[str, dict[str, Any]] = {
    "Adam": {"optimizer_kwargs": {"eps": 1e-5}},
    "weight decay": {"optimizer_kwargs": {"weight_decay": 0.1, "betas": (0.8, 0.9)}},
    "AdamW": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}},
}


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_adam_is_torchs(kind: str, request: pytest.FixtureRequest) -> None:
    def states() -> list[th.Tensor]:
        model = PolicyFlow(
            "MlpPolicy",
            "Pendulum-v1",
            policy_kwargs=OPTIMIZERS[kind],
            n_steps=32,
            batch_size=8,
            n_epochs=2,
            seed=0,
        )
        train(model, 32)
        found = model.policy.optimizer.state_dict()["state"].values()
        return [*learned(model.policy), *(value for state in found for value in state.values())]

    compiled = states()
    request.getfixturevalue("no_kernels")
    for ours, theirs in zip(compiled, states(), strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-3, atol=2e-5)


def test_hooks_of_an_optimizer_see_every_step() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=32, batch_size=8, n_epochs=2, seed=0)
    seen = []
    model.policy.optimizer.register_step_post_hook(lambda *_: seen.append(1))
    train(model, 32)
    assert len(seen) == 8


def test_what_is_prepared_for_an_epoch_is_evaluated_as_each_minibatch() -> None:
    model, update, samples = prepared(brownian_coef=0.2, log_std_bounds=(-1.0, 0.5))
    minibatches = model.rollout_buffer.minibatches(samples, 10)
    metrics = UpdateMetrics()
    losses = update.minibatch_losses(minibatches, metrics)
    for batch, (loss, kl) in zip(minibatches, losses, strict=True):
        model.policy.zero_grad()
        loss.backward()
        found = loss.item(), kl.item(), {}, [p.grad for p in learned(model.policy)]
        alone = evaluated(model, update, batch)
        assert_close(found, (*alone[:2], {}, alone[3]))
        # The next one is evaluated with other weights.
        perturb(model.policy, 0.01)
        model.policy.keep_within_bounds()


def test_losses_of_an_epoch_do_not_share_their_gradients() -> None:
    model, update, samples = prepared()
    minibatches = model.rollout_buffer.minibatches(samples, len(samples.actions) // 2)
    sums = []
    for is_compiled in (True, False):
        model.policy.zero_grad()
        if not is_compiled:
            update.compiled_loss = None
        for loss, _ in list(update.minibatch_losses(minibatches, UpdateMetrics())):
            loss.backward()
        sums.append([p.grad for p in learned(model.policy)])
    for ours, theirs in zip(*sums, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-6)


def test_a_features_extractor_that_learns_is_evaluated_for_each_minibatch() -> None:
    model, update, samples = prepared()
    layer, extract = nn.Linear(3, 3), model.policy.actor_critic_features
    model.policy.actor_critic_features = lambda observations: tuple(
        layer(features) for features in extract(observations)
    )
    for loss, _ in update.minibatch_losses(
        model.rollout_buffer.minibatches(samples, 10), UpdateMetrics()
    ):
        layer.zero_grad()
        loss.backward()
        assert layer.weight.grad.abs().max() > 0


@pytest.mark.parametrize(
    "make", [lambda std: std.to(th.bfloat16), lambda std: std.double(), lambda std: std.to("meta")]
)
def test_noise_that_is_not_float32_on_the_cpu_is_left_to_the_formulas(make: Any) -> None:
    _, update, _ = prepared()
    update.reference_log_std = make(update.reference_log_std)
    assert make_compiled_loss(update) is None


class Replacing(th.optim.SGD):
    """An optimizer that puts new memory in the place of the old."""

    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        for parameter in self.param_groups[0]["params"]:
            if parameter.grad is not None:
                parameter.data = parameter.data - self.param_groups[0]["lr"] * parameter.grad


def test_weights_may_move_between_minibatches() -> None:
    found = []
    for optimizer in (Replacing, th.optim.SGD):
        model = PolicyFlow(
            "MlpPolicy",
            "Pendulum-v1",
            learning_rate=1e-2,
            policy_kwargs={"optimizer_class": optimizer, "optimizer_kwargs": {}},
            n_steps=32,
            batch_size=8,
            seed=0,
        )
        train(model, 64)
        found.append(learned(model.policy))
    for ours, theirs in zip(*found, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_gradients_of_a_minibatch_are_its_own() -> None:
    model, update, samples = prepared()
    minibatches = model.rollout_buffer.minibatches(samples, 10)
    kept = []
    for loss, _ in update.minibatch_losses(minibatches, UpdateMetrics()):
        model.policy.zero_grad()
        loss.backward()
        kept.append(model.policy.value_net.weight.grad)
    assert len({gradient.data_ptr() for gradient in kept}) == len(kept)
    assert not th.equal(kept[0], kept[1])


class RunningFeatures(nn.BatchNorm1d):
    """State without parameters."""

    def __init__(self) -> None:
        super().__init__(3, affine=False)


@pytest.mark.parametrize("attribute", ["features_extractor", "encoder"])
def test_what_learns_or_counts_before_the_actor_sees_minibatches(attribute: str) -> None:
    model, update, samples = prepared()
    sizes, extract = [], model.policy.actor_critic_features
    counting = RunningFeatures()
    setattr(model.policy, attribute, counting)

    def features(observations: Any) -> tuple[th.Tensor, th.Tensor]:
        sizes.append(len(observations))
        return counting(extract(observations)[0]), extract(observations)[1]

    model.policy.actor_critic_features = features
    minibatches = model.rollout_buffer.minibatches(samples, 10)
    list(update.minibatch_losses(minibatches, UpdateMetrics()))
    assert sizes == [len(batch.actions) for batch in minibatches]


def test_a_pull_is_not_left_out() -> None:
    model, rollout = collected(PolicyFlow)
    model.cloned_parameters = {
        name: value.clone() + 0.1 for name, value in model.policy.state_dict().items()
    }
    model.imitation_coef = 0.5
    update = PolicyFlowUpdate(model, rollout)
    samples = rollout._replace(drawn=update.draw())
    metrics = UpdateMetrics()
    list(update.minibatch_losses(model.rollout_buffer.minibatches(samples), metrics))
    assert metrics.summary()["imitation_loss"] > 0
