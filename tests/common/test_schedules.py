import pytest

from sb3_policyflow import PolicyFlow
from sb3_policyflow.common.schedules import Coefficient, parse_schedule


@pytest.mark.parametrize(
    ("value", "start", "middle", "end"),
    [
        (0.25, 0.25, 0.25, 0.25),
        ("0.25", 0.25, 0.25, 0.25),
        ("lin_0.25", 0.25, 0.125, 0.0),
        ("lin_0.25_0.05", 0.25, 0.15, 0.05),
        ("lin_1e-3", 1e-3, 5e-4, 0.0),
        (lambda progress: progress**2, 1.0, 0.25, 0.0),
    ],
)
def test_schedules(value: Coefficient, start: float, middle: float, end: float) -> None:
    schedule = parse_schedule("brownian_coef", value)
    assert [schedule(p) for p in (1.0, 0.5, 0.0)] == pytest.approx([start, middle, end])


@pytest.mark.parametrize("value", [-0.1, "lin_-0.1", float("nan"), float("inf")])
def test_negative_or_endless_coefficients_are_refused(value: Coefficient) -> None:
    with pytest.raises(ValueError, match="brownian_coef must not be negative"):
        parse_schedule("brownian_coef", value)


@pytest.mark.parametrize("value", ["linear", "lin_", "lin_a_b", None, "0.1_0.2"])
def test_other_forms_are_refused_with_what_to_write(value: Coefficient) -> None:
    with pytest.raises(ValueError, match=r"brownian_coef must be a number.*'lin_0\.25'"):
        parse_schedule("brownian_coef", value)


def test_linear_schedules_end_at_zero_where_the_last_rollout_ends_too_late() -> None:
    model = PolicyFlow(
        "MlpPolicy", "Pendulum-v1", lambda progress: 1e-3 * progress, n_steps=64, n_epochs=1
    )
    model.learn(100)  # two rollouts, and so 128 steps
    assert model.num_timesteps == 128
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.0
