"""CUDA graphs compute what the operations that they record compute, to the last bit."""

import copy
import gc
import pickle
import threading
import weakref
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common import algorithm as algorithm_module
from sb3_policyflow.common import graphs as graphs_module
from sb3_policyflow.common.graphs import LossGraph
from sb3_policyflow.common.update import FlowUpdate
from sb3_policyflow.envs.multigoal import MultiGoalTensorEnv
from sb3_policyflow.envs.tensor import TensorStep
from sb3_policyflow.flows import VelocityField
from sb3_policyflow.kernels import (
    GraphMemory,
    Recording,
    make_velocity_field,
    reason_graphs_are_off,
    reason_training_is_slow,
)
from sb3_policyflow.kernels.graphs import MAX_GRAPHS
from sb3_policyflow.policyflow import PolicyFlowPolicy
from sb3_policyflow.policyflow.policyflow import PolicyFlowUpdate
from tests.helpers import perturb, train, weights

needs_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU that torch can use")
METHOD: dict[str, Any] = {"solver": "midpoint", "n_steps": 4}
OPTIONS: dict[str, Any] = {"n_steps": 8, "batch_size": 128, "n_epochs": 2, "seed": 0}


def eager(field: VelocityField, *inputs: th.Tensor) -> th.Tensor:
    with th.no_grad():
        return VelocityField.integrate(field, *inputs, **METHOD)


class Flow:
    """A field on the GPU with latents and features, and its end points."""

    def __init__(self) -> None:
        self.field: Any = make_velocity_field(2, 3, [16, 16], nn.ELU, initialization="glorot")
        self.field.cuda()
        self.inputs = th.randn(64, 2, device="cuda"), th.randn(64, 3, device="cuda")

    @property
    def n_recorded(self) -> int:
        return sum(replay is not None for replay in self.field._graphs._replays.values())

    def check(self, times: int = 3) -> None:
        for _ in range(times):
            with th.no_grad():
                found = self.field.integrate(*self.inputs, **METHOD)
            assert th.equal(found, eager(self.field, *self.inputs))


@pytest.fixture
def flow() -> Flow:
    return Flow()


@needs_gpu
def test_a_flow_is_recorded_when_its_shape_is_seen_again(flow: Flow) -> None:
    flow.check(times=1)
    assert flow.n_recorded == 0
    flow.check(times=1)
    assert flow.n_recorded == 1
    flow.inputs = th.randn(64, 2, device="cuda"), th.randn(64, 3, device="cuda")
    flow.check()
    assert flow.n_recorded == 1


@needs_gpu
def test_what_was_returned_is_not_overwritten(flow: Flow) -> None:
    flow.check()
    with th.no_grad():
        first = flow.field.integrate(*flow.inputs, **METHOD)
        kept = first.clone()
        flow.field.integrate(flow.inputs[0] + 1, flow.inputs[1], **METHOD)
    assert th.equal(first, kept)


def replace_data(field: Any) -> None:
    weight = field.hidden[2].weight
    weight.data = weight.data + 0.1


def replace_layer(field: Any) -> None:
    field.hidden[2] = nn.Linear(16, 16).cuda()


def replace_activations(field: Any) -> None:
    for place in (1, 3):
        field.hidden[place] = nn.Tanh()


def change_activation(field: Any) -> None:
    for place in (1, 3):
        field.hidden[place].alpha = 0.5


def add_hook(field: Any) -> None:
    field.hidden[1].register_forward_hook(lambda _, __, output: 0.5 * output)


@needs_gpu
@pytest.mark.parametrize(
    "change",
    [
        lambda field: perturb(field, 0.1),
        replace_data,
        replace_layer,
        replace_activations,
        change_activation,
        add_hook,
        lambda field: field.cpu().cuda(),
    ],
    ids=["in_place", "data", "layer", "activations", "option", "hook", "moved"],
)
def test_a_field_that_changes(flow: Flow, change: Callable[[Any], object]) -> None:
    flow.check()
    before = eager(flow.field, *flow.inputs)
    change(flow.field)
    flow.check()
    is_moved = change.__name__ == "<lambda>" and th.equal(before, eager(flow.field, *flow.inputs))
    assert is_moved or not th.equal(before, eager(flow.field, *flow.inputs))


@needs_gpu
def test_copies_have_no_graphs(flow: Flow) -> None:
    flow.check()
    for copied in (copy.deepcopy(flow.field), pickle.loads(pickle.dumps(flow.field))):
        other = Flow()
        other.field, other.inputs = copied, flow.inputs
        assert other.n_recorded == 0
        other.check()
        assert other.n_recorded == 1


@needs_gpu
def test_gradients_and_inference_mode_need_torch(flow: Flow) -> None:
    flow.check()
    latents = flow.inputs[0].clone().requires_grad_()
    flow.field.integrate(latents, flow.inputs[1], **METHOD).sum().backward()
    assert latents.grad is not None
    with th.inference_mode():
        found = flow.field.integrate(*flow.inputs, **METHOD)
    assert th.equal(found, eager(flow.field, *flow.inputs))


@needs_gpu
def test_few_are_kept(flow: Flow) -> None:
    for n in range(1, 3 * MAX_GRAPHS):
        flow.inputs = th.randn(n, 2, device="cuda"), th.randn(n, 3, device="cuda")
        flow.check()
    assert len(flow.field._graphs._replays) <= MAX_GRAPHS


@needs_gpu
def test_threads_and_streams(flow: Flow) -> None:
    expected = eager(flow.field, *flow.inputs)
    wrong: list[int] = []

    def work(index: int) -> None:
        stream: Any = th.cuda.Stream()
        with th.cuda.stream(stream), th.no_grad():
            for _ in range(20):
                shifted = flow.inputs[0] + index
                found = flow.field.integrate(shifted, flow.inputs[1], **METHOD)
                stream.synchronize()
                if index == 0 and not th.equal(found, expected):
                    wrong.append(index)

    threads = [threading.Thread(target=work, args=(index,)) for index in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


VARIANTS: dict[str, tuple[type[Any], dict[str, Any]]] = {
    "policyflow": (PolicyFlow, {"brownian_coef": 0.1, "ent_coef": 0.01, "desired_kl": 0.01}),
    "several_times": (PolicyFlow, {"n_times": 2, "clip_range": "lin_0.2", "clip_range_vf": 0.2}),
    "critic_first": (PolicyFlow, {"n_critic_warmup": 2, "max_grad_norm": 0.1}),
    "unequal": (PolicyFlow, {"batch_size": 100}),
    "trigflow": (PolicyFlow, {"interpolant": "trigflow", "solver": "ab2"}),
    "stochastic": (PolicyFlow, {"interpolant": "stochastic_exact", "brownian_coef": 0.1}),
    "fpo": (FPO, {"n_mc_samples": 4}),
    "aspo": (FPO, {"trust_region": "aspo", "mc_average": "objective"}),
    "spo": (FPO, {"trust_region": "spo"}),
    "dppo": (DPPO, {"target_kl": 1.0}),
    "dppo_last": (DPPO, {"n_finetuned_steps": 3, "clip_range_base": 0.01}),
}


def trained(name: str) -> Any:
    algorithm, options = VARIANTS[name]
    env = MultiGoalTensorEnv(64, seed=0, device="cuda")
    model = algorithm("MlpPolicy", env, device="cuda", **{**OPTIONS, **options})
    return train(model, 4 * 8 * 64)


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether each minibatch that a graph was asked for was one of recorded size."""
    calls: list[bool] = []
    call = LossGraph.__call__

    def watched(graph: LossGraph, batch: Any) -> Any:
        terms = call(graph, batch)
        calls.append(graph._recording is not None)
        return terms

    monkeypatch.setattr(LossGraph, "__call__", watched)
    return calls


@needs_gpu
@pytest.mark.parametrize("name", VARIANTS)
def test_training_is_the_same(
    name: str, recorded: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = trained(name)
    assert sum(recorded) >= len(recorded) - 1 > 0  # the first ever is not recorded
    logged = dict(model.logger.name_to_value)
    monkeypatch.setattr(algorithm_module, "record_losses", lambda *_: None)
    recorded.clear()
    plain = trained(name)
    assert not recorded
    assert th.equal(weights(model), weights(plain))
    of_training = {key for key in logged if key.startswith("train/")}
    assert of_training
    for key in of_training:
        assert logged[key] == pytest.approx(plain.logger.name_to_value[key], rel=1e-6), key


class Rerun(Recording[Any]):
    """Stands for a graph where there is no GPU: writes to the same tensors in each replay."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self.function, self.result, self.n_replays = function, function(), 0

    def replay(self) -> Any:
        self.n_replays += 1
        again = self.function()
        self.result._numbers.copy_(again._numbers)
        for (_, old), (_, new) in zip(self.result._gradients, again._gradients, strict=True):
            assert (old is None) == (new is None)
            if old is not None:
                old.copy_(new)
        return self.result


class MemoryWithoutGPU(GraphMemory):
    """Memory of what is recorded where there is no GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.recordings: list[Rerun] = []

    def record(self, function: Callable[[], Any], device: th.device) -> Any:
        assert device.type == "cpu"
        self.recordings.append(Rerun(function))
        return self.recordings[-1]


class Recorder:
    """Lets updates be recorded without a GPU, and keeps what a test wants to see."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.memory, self.updates = MemoryWithoutGPU(), list[Any]()
        monkeypatch.setattr(algorithm_module, "record_losses", self.record)

    def record(self, _: Any, update: FlowUpdate) -> None:
        self.updates.append(weakref.ref(update))
        parameters = list(update.policy.parameters())
        update.recorded_loss = LossGraph(update.loss, parameters, update.batch_size, self.memory)


def learn(algorithm: type[Any], **options: Any) -> Any:
    sizes: dict[str, Any] = {"n_steps": 64, "batch_size": 24, "n_epochs": 2, "seed": 0}
    return train(algorithm("MlpPolicy", "Pendulum-v1", **sizes, **options), 3 * 64)


@pytest.mark.usefixtures("no_kernels")
def test_updates_are_the_same_without_a_gpu(
    algorithm: type[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """64 samples are two minibatches of full size, and one that is smaller."""
    plain = learn(algorithm, n_critic_warmup=1)
    recorder = Recorder(monkeypatch)
    model = learn(algorithm, n_critic_warmup=1)
    # Of the first update, one minibatch of full size is evaluated before any is recorded.
    assert [each.n_replays for each in recorder.memory.recordings] == [3, 4, 4]
    assert th.equal(weights(model), weights(plain))
    logged = plain.logger.name_to_value
    for key in [key for key in logged if key.startswith("train/")]:
        assert model.logger.name_to_value[key] == logged[key], key


@pytest.mark.usefixtures("no_kernels")
def test_updates_do_not_outlive_their_training(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder(monkeypatch)
    gc.disable()
    try:
        learn(PolicyFlow)
        assert len(recorder.updates) == 3
        assert all(update() is None for update in recorder.updates)
    finally:
        gc.enable()


class Replacing(th.optim.SGD):
    """Gives each parameter new memory in each step."""

    def step(self, closure: Any = None) -> None:
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    parameter.data = parameter.data - group["lr"] * parameter.grad


@pytest.mark.usefixtures("no_kernels")
def test_parameters_that_are_replaced_are_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"policy_kwargs": {"optimizer_class": Replacing, "initialization": "glorot"}}
    plain = learn(PolicyFlow, **options)
    recorder = Recorder(monkeypatch)
    model = learn(PolicyFlow, **options)
    assert sum(each.n_replays for each in recorder.memory.recordings) <= len(recorder.updates)
    assert th.equal(weights(model), weights(plain))


class OwnSteps(PolicyFlow):
    def _optimize(self, *arguments: Any) -> None:
        super()._optimize(*arguments)


class BareUpdate(PolicyFlowUpdate, may_be_recorded=True):
    """As much of an update on a GPU as decides on recording."""

    def __init__(self) -> None:
        self.batch_size, self.recorded_loss = 8, None
        self.policy = mock.Mock(device=th.device("cuda"), **{"parameters.return_value": []})


def test_steps_of_ones_own_are_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs_module, "reason_graphs_are_off", lambda _: None)
    for cls in (PolicyFlow, OwnSteps):
        update = BareUpdate()
        graphs_module.record_losses(object.__new__(cls), update)
        assert (update.recorded_loss is not None) == (cls is PolicyFlow)


@needs_gpu
@pytest.mark.parametrize(
    ("algorithm", "option", "metric"),
    [
        (PolicyFlow, {"uniform_noise_coef": 1.0}, "uniform_noise_loss"),
        (FPO, {"ent_coef": 0.1}, "entropy_loss"),
        (DPPO, {"ent_coef": 0.1}, "entropy_loss"),
    ],
    ids=["policyflow", "fpo", "dppo"],
)
def test_random_numbers_in_the_loss(
    algorithm: Any, option: dict[str, Any], metric: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each replay draws others."""
    drawn, call = [], LossGraph.__call__

    def watched(graph: LossGraph, batch: Any) -> Any:
        terms = call(graph, batch)
        drawn.append(float(terms.means[metric]))
        return terms

    monkeypatch.setattr(LossGraph, "__call__", watched)
    env = MultiGoalTensorEnv(64, seed=0, device="cuda")
    options = {**OPTIONS, "n_epochs": 4, "learning_rate": 1e-12, **option}
    algorithm("MlpPolicy", env, device="cuda", **options).learn(3 * 8 * 64)
    assert len(set(drawn)) == len(drawn) == 3 * 4 * 4


@needs_gpu
def test_memory_does_not_grow() -> None:
    model = trained("policyflow")
    reserved = []
    for _ in range(3):
        model.learn(3 * 8 * 64, reset_num_timesteps=False)
        reserved.append(th.cuda.memory_reserved())
    assert reserved[1] == reserved[2]


class OwnExtractor(FlattenExtractor):
    pass


class OwnPolicy(PolicyFlowPolicy):
    pass


class OwnUpdate(PolicyFlowUpdate):
    pass


def make_policy(policy: Any = "MlpPolicy", **policy_kwargs: Any) -> Any:
    return PolicyFlow(policy, "Pendulum-v1", policy_kwargs=policy_kwargs, device="cpu").policy


def test_reasons() -> None:
    assert reason_graphs_are_off(make_policy()) == "the policy is on cpu"
    assert reason_training_is_slow(make_policy()) is None
    own = reason_graphs_are_off(make_policy(OwnPolicy))
    assert own == "OwnPolicy is a policy of your own"
    with th.autograd.detect_anomaly(check_nan=False):
        assert reason_graphs_are_off(make_policy()) == "torch looks for anomalies"
    policy = make_policy()
    policy.velocity = VelocityField(1, 3)
    reason = reason_graphs_are_off(policy)
    assert reason == "VelocityField is not a velocity field of kernels"


@needs_gpu
def test_reasons_on_a_gpu() -> None:
    def reason(**policy_kwargs: Any) -> str | None:
        policy = make_policy(**policy_kwargs).cuda()
        return reason_training_is_slow(policy)

    assert reason() is None
    for options, part in (
        ({"features_extractor_class": OwnExtractor}, "OwnExtractor is a features extractor"),
        ({"activation_fn": nn.Softsign}, "activation Softsign is not among"),
        ({"net_arch": {"pi": [8], "vf": []}}, "for the critic, a network has no hidden layers"),
    ):
        assert part in str(reason(**options))
    policy = make_policy().cuda()
    handle = policy.log_std.register_hook(lambda gradient: gradient)
    assert "parameters have hooks" in str(reason_training_is_slow(policy))
    handle.remove()
    assert reason_training_is_slow(policy) is None


def test_formulas_of_ones_own_are_not_recorded() -> None:
    assert PolicyFlowUpdate.may_be_recorded
    assert not OwnUpdate.may_be_recorded
    assert not FlowUpdate.may_be_recorded


@needs_gpu
def test_images_and_dictionaries() -> None:
    class Images:
        """A step of each observation is another."""

        def __init__(self) -> None:
            self.num_envs, self.device = 8, th.device("cuda")
            self.observation_space = spaces.Dict(
                image=spaces.Box(0, 255, (1, 36, 36), np.uint8), vector=spaces.Box(-1, 1, (3,))
            )
            self.action_space = spaces.Box(-1, 1, (2,), np.float32)

        def reset(self) -> Any:
            image = th.randint(0, 255, (8, 1, 36, 36), dtype=th.uint8, device="cuda")
            return {"image": image, "vector": th.rand(8, 3, device="cuda")}

        def step(self, actions: th.Tensor) -> Any:
            never = th.zeros(8, dtype=th.bool, device="cuda")
            ended = th.zeros(0, dtype=th.int64, device="cuda")
            observations = self.reset()
            finals = {key: values[:0] for key, values in observations.items()}
            rewards = -actions.square().sum(1)
            return TensorStep(observations, rewards, never, never, ended, finals)

    results = []
    for is_recorded in (True, False):
        with pytest.MonkeyPatch.context() as patch:
            if not is_recorded:
                patch.setattr(algorithm_module, "record_losses", lambda *_: None)
            options = {**OPTIONS, "batch_size": 16}
            model = PolicyFlow("MultiInputPolicy", Images(), device="cuda", **options)
            results.append(weights(train(model, 3 * 64)))
    # Gradients of convolutions are sums in an order that may change.
    th.testing.assert_close(results[0], results[1], rtol=1e-3, atol=1e-4)
