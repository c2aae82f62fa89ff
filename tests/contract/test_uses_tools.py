"""torch's tools, threads, processes and trackers around a model."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam, configure
from torch import nn
from torch.nn.utils import parametrizations, prune

from tests.contract.uses import learned, make, output_layer
from tests.helpers import assert_trained, weights

pytestmark = pytest.mark.slow

SEEN = np.linspace(-1, 1, 30).reshape(10, 3).astype(np.float32)


def actions(model: Any) -> np.ndarray:
    return np.asarray(model.predict(SEEN, deterministic=True)[0])


# Layers that are replaced or changed


def test_dynamic_quantization(any_algorithm: type[Any]) -> None:
    model = learned(any_algorithm)
    expected = actions(model)  # after an update PPO cannot be copied before it has acted
    small = th.ao.quantization.quantize_dynamic(model.policy, {nn.Linear}, dtype=th.qint8)
    found, _ = small.predict(SEEN, deterministic=True)
    np.testing.assert_allclose(found, expected, atol=0.05)


class LowRank(nn.Module):
    """A linear layer with a correction of low rank, as LoRA's."""

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__()
        self.layer = layer
        self.down = nn.Linear(layer.in_features, 2, bias=False)
        self.up = nn.Linear(2, layer.out_features, bias=False)
        nn.init.constant_(self.up.weight, 0.05)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        result: th.Tensor = self.layer(inputs) + self.up(self.down(inputs))
        return result


def low_rank(model: Any) -> None:
    name = "action_net" if isinstance(model, PPO) else "output"
    holder = model.policy if isinstance(model, PPO) else model.policy.velocity
    setattr(holder, name, LowRank(getattr(holder, name)))


CHANGES: dict[str, Callable[[Any], object]] = {
    "prune": lambda model: prune.l1_unstructured(output_layer(model), "weight", amount=0.5),
    "weight_norm": lambda model: (
        parametrizations.weight_norm(output_layer(model)),
        nn.init.constant_(output_layer(model).parametrizations.weight.original0, 0.3),
    ),
    "spectral_norm": lambda model: parametrizations.spectral_norm(output_layer(model)),
    "low_rank": low_rank,
    "data": lambda model: setattr(
        output_layer(model).weight, "data", th.full_like(output_layer(model).weight, 0.1)
    ),
    "share_memory": lambda model: (
        model.policy.share_memory(),
        output_layer(model).bias.data.add_(0.1),
    ),
    "in_place": lambda model: output_layer(model).bias.data.add_(0.1),
}


@pytest.mark.parametrize("change", CHANGES)
def test_changed_layers_act_and_learn(any_algorithm: type[Any], change: str) -> None:
    model = learned(any_algorithm)
    before = actions(model)
    CHANGES[change](model)
    after = actions(model)
    assert np.abs(after - before).max() > 1e-6
    with th.no_grad():
        plain = copy.deepcopy(model)
        np.testing.assert_allclose(actions(plain), after, atol=1e-6)
    parameters = list(model.policy.parameters())
    model.policy.optimizer = th.optim.Adam(parameters, lr=1e-2, eps=1e-5)
    old = [parameter.detach().clone() for parameter in parameters]
    model.learn(32)
    assert any(not th.equal(one, other) for one, other in zip(old, parameters, strict=True))
    assert np.isfinite(actions(model)).all()


def test_frozen_layers_stay(any_algorithm: type[Any]) -> None:
    model = make(any_algorithm)
    frozen = list(model.policy.mlp_extractor.parameters())
    for parameter in frozen:
        parameter.requires_grad_(False)
    before, old = weights(model), [parameter.clone() for parameter in frozen]
    assert_trained(model.learn(64), before)
    assert all(th.equal(one, other) for one, other in zip(old, frozen, strict=True))


# Gradients


def test_gradients_with_respect_to_observations(any_algorithm: type[Any]) -> None:
    """Those of deterministic actions and of values, against finite differences."""
    policy = learned(any_algorithm).policy
    policy.set_training_mode(False)
    point, step = th.as_tensor(SEEN[:3]), 1e-2

    def act(x: th.Tensor) -> th.Tensor:
        result: th.Tensor = policy._predict(x, deterministic=True)
        return result

    for function in (act, policy.predict_values, lambda x: policy(x, deterministic=True)[1]):
        whole = th.autograd.functional.jacobian(lambda x, f=function: f(x).sum(), point)
        for column in range(3):
            moved = step * nn.functional.one_hot(th.tensor(column), 3)
            with th.no_grad():
                slope = (function(point + moved) - function(point - moved)).sum(-1) / (2 * step)
            th.testing.assert_close(whole[:, column], slope, atol=5e-3, rtol=0.02)
    jacobian = th.func.jacrev(lambda x: act(x[None])[0])
    found = th.func.vmap(jacobian)(point)
    expected = th.stack([jacobian(row) for row in point])
    th.testing.assert_close(found, expected)


def test_hooks_see_each_call(any_algorithm: type[Any]) -> None:
    model = make(any_algorithm)
    calls: list[str] = []
    layer = output_layer(model)
    layer.register_forward_hook(lambda *_: calls.append("forward"))
    layer.register_full_backward_hook(lambda *_: calls.append("backward"))
    layer.weight.register_hook(lambda _: calls.append("parameter"))
    actions(model)
    assert calls.count("forward") >= 1
    model.learn(16)
    assert {"forward", "backward", "parameter"} <= set(calls)


def test_global_hooks_see_each_call(any_algorithm: type[Any]) -> None:
    """As profilers and trackers set them."""
    model, calls = make(any_algorithm), []
    handle = nn.modules.module.register_module_forward_hook(lambda *_: calls.append(1))
    try:
        actions(model)
    finally:
        handle.remove()
    assert len(calls) >= 3


def test_counted_operations(any_algorithm: type[Any]) -> None:
    counter = pytest.importorskip("torch.utils.flop_counter").FlopCounterMode(display=False)
    model = make(any_algorithm)
    with counter:
        actions(model)
    assert counter.get_total_flops() > 0


# Modes


def _detect_anomaly() -> Any:
    return th.autograd.set_detect_anomaly(True)


@pytest.mark.parametrize("mode", [th.inference_mode, th.enable_grad, _detect_anomaly])
def test_predictions_in_modes_of_torch(any_algorithm: type[Any], mode: Any) -> None:
    model = learned(any_algorithm)
    expected = actions(model)
    with mode():
        np.testing.assert_array_equal(actions(model), expected)


def test_training_in_modes_of_torch(any_algorithm: type[Any]) -> None:
    expected = weights(make(any_algorithm).learn(32))
    th.use_deterministic_algorithms(True)
    try:
        with th.autograd.set_detect_anomaly(True):
            assert th.allclose(weights(make(any_algorithm).learn(32)), expected)
    finally:
        th.use_deterministic_algorithms(False)


@pytest.mark.parametrize(
    ("set_default", "other", "usual"),
    [
        (th.set_default_device, "meta", "cpu"),  # "meta" stands for "cuda"
        (th.set_default_dtype, th.float64, th.float32),
        (th.set_default_dtype, th.float16, th.float32),
    ],
)
def test_other_defaults_of_torch(
    any_algorithm: type[Any], set_default: Any, other: Any, usual: Any
) -> None:
    """Set after the model was made, by another library."""
    model = make(any_algorithm)
    before = weights(model)
    set_default(other)
    try:
        model.learn(32)
        found = actions(model)
    finally:
        set_default(usual)
    assert_trained(model, before)
    np.testing.assert_allclose(actions(model), found, atol=1e-6)


def test_jit_trace_at_another_batch_size(any_algorithm: type[Any]) -> None:
    policy = learned(any_algorithm).policy
    act = _Deterministic(policy)
    traced = th.jit.trace(act, th.as_tensor(SEEN[:2]), check_trace=False)
    th.testing.assert_close(traced(th.as_tensor(SEEN)), act(th.as_tensor(SEEN)))


class _Deterministic(nn.Module):
    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: th.Tensor) -> th.Tensor:
        result: th.Tensor = self.policy._predict(observation, deterministic=True)
        return result


def test_export_and_autocast(algorithm: type[Any]) -> None:
    """What PPO's policies do not do: its distributions refuse."""
    model = learned(algorithm)
    act = _Deterministic(model.policy)
    exported = th.export.export(act, (th.as_tensor(SEEN),)).module()
    th.testing.assert_close(exported(th.as_tensor(SEEN)), act(th.as_tensor(SEEN)))
    with th.autocast("cpu", dtype=th.bfloat16):
        assert np.isfinite(actions(model)).all()


# Trackers


class Tracked(BaseCallback):
    """Logs hyperparameters, as SB3's documentation shows, and looks at gradients, as wandb does."""

    def _on_training_start(self) -> None:
        model: Any = self.model
        values = {"algorithm": type(model).__name__, "gamma": model.gamma}
        names: dict[str, float] = {"rollout/ep_len_mean": 0, "train/value_loss": 0.0}
        self.logger.record(
            "hparams", HParam(values, names), exclude=("stdout", "log", "json", "csv")
        )
        self.norms: list[float] = []
        for parameter in filter(lambda p: p.requires_grad, model.policy.parameters()):
            parameter.register_hook(lambda gradient: self.norms.append(gradient.norm().item()))

    def _on_step(self) -> bool:
        self.logger.record("own/steps", self.num_timesteps)
        return True


def test_trackers_change_nothing(any_algorithm: type[Any], tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    model = make(any_algorithm)
    model.set_logger(configure(str(tmp_path), ["tensorboard", "csv", "json", "log"]))
    tracker = Tracked()
    model.learn(64, tracker)
    # Hooks of parameters see torch's gradients, which equal those of kernels up to rounding.
    untracked = weights(make(any_algorithm).learn(64))
    th.testing.assert_close(weights(model), untracked, rtol=1e-4, atol=1e-6)
    assert len(tracker.norms) > 0
    assert np.isfinite(tracker.norms).all()
    assert {"progress.csv", "progress.json", "log.txt"} <= {
        path.name for path in tmp_path.iterdir()
    }
