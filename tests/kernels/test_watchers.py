"""Who watches all modules or all of torch's functions sees what a policy does."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import torch as th
from torch.nn.modules import module as hooks
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from sb3_policyflow.common.optimization import clip_gradients
from sb3_policyflow.kernels import reason_kernels_are_off
from tests.helpers import SMALL, TINY
from tests.kernels.plain import make_field

OBSERVATION = np.zeros(3, np.float32)


class Functions(TorchFunctionMode):
    """Notes the names of functions that are called."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.seen.append(func.__name__)
        return func(*args, **(kwargs or {}))


class Operators(TorchDispatchMode):
    """Notes the names of operators that are dispatched."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.seen.append(str(func))
        return func(*args, **(kwargs or {}))


@contextmanager
def global_hook(register: Any) -> Iterator[list[Any]]:
    seen: list[Any] = []
    handle = register(lambda module, *_: seen.append(module))
    try:
        yield seen
    finally:
        handle.remove()


REGISTER = [
    hooks.register_module_forward_hook,
    hooks.register_module_forward_pre_hook,
    hooks.register_module_full_backward_hook,
    hooks.register_module_full_backward_pre_hook,
]


@pytest.mark.filterwarnings("ignore:Full backward hook")
@pytest.mark.parametrize("register", REGISTER)
def test_hooks_of_all_modules_see_every_module_of_a_field(register: Any) -> None:
    field = make_field(2, 3, [8, 8])
    z, s = th.randn(4, 2, requires_grad=True), th.randn(4, 3, requires_grad=True)
    with global_hook(register) as seen:
        field.integrate(z, s, solver="euler", n_steps=2).sum().backward()
    assert {id(module) for module in field.modules()} <= {id(module) for module in seen}


def test_hooks_of_all_modules_see_a_policy_act_and_learn(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, device="cpu", **SMALL)
    policy, velocity = model.policy, model.policy.velocity
    model.predict(OBSERVATION)
    with global_hook(hooks.register_module_forward_hook) as seen:
        assert reason_kernels_are_off(policy) == "there are hooks for all modules"
        model.predict(OBSERVATION)
        acting = set(map(id, seen))
        seen.clear()
        model.learn(SMALL["n_steps"])
    assert {id(velocity), id(velocity.output), id(velocity.hidden[0])} <= acting
    assert {id(velocity.output), id(policy.value_net)} <= set(map(id, seen))
    assert reason_kernels_are_off(policy) is None


@pytest.mark.parametrize("watch", [Functions, Operators])
def test_modes_see_a_policy_act(algorithm: Any, watch: Any) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, device="cpu", **SMALL)
    model.predict(OBSERVATION)
    mode = watch()
    with mode:
        reason = reason_kernels_are_off(model.policy)
        model.predict(OBSERVATION)
    assert reason == "a mode takes part in torch's functions"
    assert sum("linear" in name or "addmm" in name for name in mode.seen) > 10
    assert reason_kernels_are_off(model.policy) is None


def test_a_mode_sees_gradients_clipped() -> None:
    with Operators() as mode:
        parameter = th.nn.Parameter(th.ones(3))
        parameter.grad = th.ones(3)
        mode.seen.clear()
        clip_gradients([parameter], 1.0)
    assert any("norm" in name for name in mode.seen)


def test_operations_are_counted_as_without_kernels(
    algorithm: Any, request: pytest.FixtureRequest
) -> None:
    def count() -> int:
        model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, device="cpu", **SMALL)
        with FlopCounterMode(display=False) as counter:
            model.learn(SMALL["n_steps"])
        return int(counter.get_total_flops())

    found = count()
    request.getfixturevalue("no_kernels")
    assert found == count() > 0


class Named(th.Tensor):
    """A tensor of a class that may have its own functions."""


def test_inputs_of_another_class_keep_it() -> None:
    field = make_field(2, 3, [8, 8])
    z, s = th.randn(4, 2), th.randn(4, 3).as_subclass(Named)
    with th.no_grad():
        assert isinstance(field(z, th.rand(4), s), Named)
        assert isinstance(field.integrate(z, s, solver="euler", n_steps=2), Named)


def test_a_parameter_of_another_class_is_torchs(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, device="cpu", **SMALL)
    output = model.policy.velocity.output
    output._parameters["weight"] = output.weight.detach().as_subclass(Named)
    assert reason_kernels_are_off(model.policy) == "a Named takes the place of a parameter"
    model.predict(OBSERVATION)


def test_shapes_that_do_not_fit_are_torchs_to_refuse(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, device="cpu", **SMALL)
    velocity = model.policy.velocity
    velocity.output.weight.data = th.randn(1, 7)
    assert "do not fit" in str(reason_kernels_are_off(model.policy))
    with pytest.raises(RuntimeError):
        model.predict(OBSERVATION)
    velocity.output.weight.data = th.randn(1, 8)
    velocity.observation_embedding.weight.data = th.randn(7, 3)
    assert "do not fit" in str(reason_kernels_are_off(model.policy))
    with pytest.raises(RuntimeError):
        model.predict(OBSERVATION)
