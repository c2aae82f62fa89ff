import pytest

from sb3_policyflow.common.schedules import KLAdaptiveLearningRate, check_lr_adaptation

RULE = KLAdaptiveLearningRate(bounds=(1e-4, 1e-3))


@pytest.mark.parametrize(
    ("learning_rate", "kl", "expected"),
    [
        (6e-4, 0.0201, 4e-4),  # more than twice the target
        (6e-4, 0.0199, 6e-4),
        (6e-4, 0.0051, 6e-4),
        (6e-4, 0.0049, 9e-4),  # less than half the target
        (1.2e-4, 0.1, 1e-4),  # stops at the bounds
        (9e-4, 0.0, 1e-3),
        (3e-3, 0.0, 3e-3),  # a start outside them may only move towards them
        (3e-3, 0.1, 2e-3),
        (1e-5, 0.1, 1e-5),
        (1e-5, 0.0, 1.5e-5),
        (0.0, 0.0, 0.0),
    ],
)
def test_rule(learning_rate: float, kl: float, expected: float) -> None:
    assert RULE.adapt(learning_rate, kl, desired_kl=0.01) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"factor": 1.0}, "factor must be greater than 1"),
        ({"bounds": (1e-2, 1e-6)}, "bounds must be two numbers in order"),
    ],
)
def test_rules_that_cannot_work_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_lr_adaptation("lr_adaptation_kwargs", options)
