"""Training with kernels is training without, up to rounding."""

import gc
import weakref
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.optimization import clip_gradients, make_optimizer
from sb3_policyflow.common.update import UpdateMetrics
from sb3_policyflow.kernels.compiler import SWITCH, load_kernels
from sb3_policyflow.policyflow.policyflow import PolicyFlowUpdate
from tests.helpers import learned
from tests.kernels.plain import Critic, make_field
from tests.resilience.test_collection import Clock

MISH = {"net_arch": [32, 16], "activation_fn": th.nn.Mish, "initialization": "glorot"}


def train(algorithm: Any, **options: Any) -> th.Tensor:
    """Parameters after one update."""
    env = make_vec_env("Pendulum-v1", n_envs=4, seed=0)
    model = algorithm("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=2, seed=0, **options)
    model.learn(128)
    vector: np.ndarray = model.policy.parameters_to_vector()
    return th.as_tensor(vector)


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (PolicyFlow, {"policy_kwargs": MISH}),
        (PolicyFlow, {"policy_kwargs": MISH, "brownian_coef": 0.25, "ent_coef": 0.01}),
        (PolicyFlow, {"policy_kwargs": MISH, "time_sampler": "uniform", "n_times": 3}),
        (PolicyFlow, {"policy_kwargs": MISH, "interpolant": "trigflow", "clip_range_vf": 0.2}),
        (PolicyFlow, {"policy_kwargs": {**MISH, "activation_fn": th.nn.Softsign}}),
        (FPO, {"policy_kwargs": MISH}),
        (DPPO, {"policy_kwargs": MISH}),
    ],
)
def test_one_update(
    algorithm: Any, options: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    fused = train(algorithm, **options)
    request.getfixturevalue("no_kernels")
    assert load_kernels() == f"{SWITCH} is 0"
    th.testing.assert_close(fused, train(algorithm, **options), rtol=0, atol=2e-5)


class Picture(Clock):
    """A clock that shows an image."""

    def __init__(self) -> None:
        super().__init__(limit=5)
        self.observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)

    def observation(self) -> Any:
        return np.full((36, 36, 3), 40 * self.time, dtype=np.uint8)


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy", "MultiInputPolicy"])
def test_features_extractors(policy: str, request: pytest.FixtureRequest) -> None:
    def gradients() -> list[th.Tensor]:
        make: Any = {"CnnPolicy": Picture, "MultiInputPolicy": lambda: Clock(as_dict=True)}
        env = DummyVecEnv([make.get(policy, Clock)] * 2)
        kwargs = {"initialization": "glorot"}
        model = PolicyFlow(policy, env, n_steps=8, batch_size=16, seed=0, policy_kwargs=kwargs)
        model.learn(16)
        th.manual_seed(0)
        rollout = model.rollout_buffer.samples()
        update = PolicyFlowUpdate(model, rollout)
        rollout = rollout._replace(drawn=update.draw())
        features, critic_features = model.policy.actor_critic_features(rollout.observations)
        terms = update.terms(rollout, features)
        loss = update.surrogate_loss(terms.log_ratio, rollout.advantages, UpdateMetrics())
        values = model.policy.values(critic_features).flatten()
        loss = loss + terms.regularizer + (values - rollout.returns).square().mean()
        return list(th.autograd.grad(loss, learned(model.policy)))

    fused = gradients()
    request.getfixturevalue("no_kernels")
    for ours, theirs in zip(fused, gradients(), strict=True):
        scale = theirs.abs().max().item()
        th.testing.assert_close(ours, theirs, rtol=0, atol=1e-4 * scale + 1e-6)


def parameters(*gradients: Any) -> list[th.nn.Parameter]:
    result = []
    for gradient in gradients:
        parameter = th.nn.Parameter(th.zeros_like(th.as_tensor(gradient)))
        parameter.grad = th.as_tensor(gradient)
        result.append(parameter)
    return result


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("max_norm", [0.1, 5.0, 100.0])
def test_gradients_are_clipped_as_torch_does(max_norm: float, dtype: th.dtype) -> None:
    gradients = [th.randn(7, 5, dtype=dtype), th.randn(3, dtype=dtype)]
    ours = parameters(
        *(g.clone() for g in gradients),
    )
    theirs = parameters(*(g.clone() for g in gradients))
    norm = th.nn.utils.clip_grad_norm_(theirs, max_norm)
    assert clip_gradients(ours, max_norm) == pytest.approx(norm.item(), rel=1e-6)
    for a, b in zip(ours, theirs, strict=True):
        th.testing.assert_close(a.grad, b.grad)


@pytest.mark.parametrize("number", [th.nan, th.inf])
@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_gradients_that_are_not_finite_are_left_alone(number: float, dtype: th.dtype) -> None:
    (good, bad) = parameters(th.ones(2, dtype=dtype), th.tensor([number], dtype=dtype))
    assert not np.isfinite(clip_gradients([good, bad], 0.5))
    assert good.grad is not None
    assert good.grad.tolist() == [1.0, 1.0]


def test_fused_optimizer_is_the_default_and_can_be_declined() -> None:
    model = PolicyFlow("MlpFlowPolicy", "Pendulum-v1")
    assert model.policy.optimizer.defaults["fused"]
    assert model.policy.optimizer.defaults["eps"] == 1e-5  # SB3's
    kwargs = {"optimizer_kwargs": {"fused": False}}
    model = PolicyFlow("MlpFlowPolicy", "Pendulum-v1", policy_kwargs=kwargs)
    assert not model.policy.optimizer.defaults["fused"]
    weights = [th.nn.Parameter(th.ones(1))]
    assert isinstance(make_optimizer(th.optim.SGD, weights, 0.1, {}), th.optim.SGD)


def test_an_optimizer_state_of_the_other_implementation_is_taken_over(tmp_path: Any) -> None:
    options: dict[str, Any] = {"n_steps": 32, "batch_size": 32, "n_epochs": 1, "seed": 0}
    declined = {"optimizer_kwargs": {"foreach": False, "eps": 1e-5}}
    old = PolicyFlow("MlpFlowPolicy", "Pendulum-v1", policy_kwargs=declined, **options).learn(32)
    old.save(tmp_path / "old")
    new = PolicyFlow("MlpFlowPolicy", "Pendulum-v1", **options)
    new.set_parameters(str(tmp_path / "old.zip"))
    new.learn(32)
    steps = {int(state["step"]) for state in new.policy.optimizer.state.values()}
    assert steps == {2}


def field_evaluation() -> th.Tensor:
    field = make_field(2, 3, [8, 8])
    velocity: th.Tensor = field(th.randn(5, 2), th.rand(5), th.randn(5, 3))
    return velocity


def critic_evaluation() -> th.Tensor:
    values: th.Tensor = Critic(th.nn.Linear(2, 8), th.nn.Tanh(), th.nn.Linear(8, 1))(th.randn(5, 2))
    return values


@pytest.mark.parametrize("evaluate", [field_evaluation, critic_evaluation])
def test_nothing_outlives_the_graph(evaluate: Any) -> None:
    """A cycle of references would hold what each minibatch has kept for the way back."""
    gc.collect()
    gc.disable()
    try:
        outputs = evaluate()
        node: Any = outputs.grad_fn
        while not hasattr(node, "evaluation"):
            node = node.next_functions[0][0]
        evaluation = weakref.ref(node.evaluation)
        assert evaluation() is not None
        del outputs, node
        assert evaluation() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("evaluate", [field_evaluation, critic_evaluation])
def test_what_was_kept_is_given_back_after_the_way_back(evaluate: Any) -> None:
    loss = evaluate().sum()
    loss.backward()
    with pytest.raises(RuntimeError, match="second time"):
        loss.backward()
