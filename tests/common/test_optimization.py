"""Optimizers in their fused form, and gradients clipped as torch clips them."""

import math
from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_policyflow.common.optimization import clip_gradients, make_optimizer

# In float32 a kernel clips, in float64 torch does.
DTYPES = [th.float32, th.float64]


def parameters(dtype: th.dtype = th.float32) -> list[nn.Parameter]:
    """Three parameters, of which the last has no gradient."""
    made = [nn.Parameter(th.randn(shape, dtype=dtype)) for shape in ((4, 3), (5,), (2,))]
    for parameter in made[:2]:
        parameter.grad = 3 * th.randn_like(parameter)
    return made


def gradients(made: list[nn.Parameter]) -> list[th.Tensor]:
    return [parameter.grad.clone() for parameter in made if parameter.grad is not None]


@pytest.mark.parametrize("optimizer_class", [th.optim.Adam, th.optim.AdamW])
def test_adam_is_fused_unless_the_user_chooses(optimizer_class: type[Any]) -> None:
    optimizer = make_optimizer(optimizer_class, parameters(), 1e-3, {"eps": 1e-5})
    assert type(optimizer) is optimizer_class
    assert (optimizer.defaults["fused"], optimizer.defaults["eps"]) == (True, 1e-5)
    assert optimizer.param_groups[0]["lr"] == 1e-3
    for options in ({"fused": False}, {"foreach": True}, {"capturable": False}):
        chosen = make_optimizer(optimizer_class, parameters(), 1e-3, options)
        assert not chosen.defaults["fused"]
        assert options.items() <= chosen.defaults.items()


def test_other_optimizers_are_as_they_are() -> None:
    optimizer = make_optimizer(th.optim.RMSprop, parameters(), 1e-3, {"alpha": 0.9})
    assert isinstance(optimizer, th.optim.RMSprop)
    assert optimizer.defaults["alpha"] == 0.9


def test_a_fused_step_is_that_of_the_plain_optimizer() -> None:
    fused, plain = parameters(), parameters()
    with th.no_grad():
        for one, other in zip(fused, plain, strict=True):
            other.copy_(one)
            other.grad = None if one.grad is None else one.grad.clone()
    make_optimizer(th.optim.Adam, fused, 1e-2, {}).step()
    th.optim.Adam(plain, 1e-2, foreach=False).step()
    for one, other in zip(fused, plain, strict=True):
        th.testing.assert_close(one, other)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("max_norm", [0.5, 1e3, math.inf])
def test_gradients_are_clipped_as_torch_clips_them(dtype: th.dtype, max_norm: float) -> None:
    ours, theirs = parameters(dtype), parameters(dtype)
    for one, other in zip(ours, theirs, strict=True):
        other.grad = None if one.grad is None else one.grad.clone()
    norm = clip_gradients(ours, max_norm)
    expected = nn.utils.clip_grad_norm_(theirs, max_norm)
    assert norm == pytest.approx(expected.item(), rel=1e-5)
    for our, their in zip(gradients(ours), gradients(theirs), strict=True):
        th.testing.assert_close(our, their)
    assert ours[2].grad is None


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_gradients_that_are_not_finite_are_left_alone(dtype: th.dtype, number: float) -> None:
    made = parameters(dtype)
    assert made[0].grad is not None
    made[0].grad[1, 2] = number
    before = gradients(made)
    assert not math.isfinite(clip_gradients(made, 0.5))
    for old, new in zip(before, gradients(made), strict=True):
        th.testing.assert_close(new, old, equal_nan=True, atol=0.0, rtol=0.0)
