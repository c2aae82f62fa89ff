"""The learning rate that follows the divergence of the policy."""

from dataclasses import dataclass

from sb3_policyflow.common.checks import check_between, check_bounds, check_positive


@dataclass(frozen=True)
class KLAdaptiveLearningRate:
    """Lowers the learning rate when the policy changes too much and raises it when too little.

    lr / factor if KL > margin * target,    lr * factor if KL < target / margin

    The rule of RSL-RL and skrl, on which the paper builds.

    >>> rule = KLAdaptiveLearningRate()
    >>> [round(rule.adapt(3e-4, kl, desired_kl=0.01), 7) for kl in (0.03, 0.01, 0.001)]
    [0.0002, 0.0003, 0.00045]

    :param factor: By how much the learning rate changes at a time.
    :param margin: How far off the target the divergence may be.
    :param bounds: Lowest and highest learning rate.
    :raises ValueError: If a parameter is out of its range.
    """

    factor: float = 1.5
    margin: float = 2.0
    bounds: tuple[float, float] = (1e-6, 1e-2)

    def __post_init__(self) -> None:
        check_between("kl_margin", self.margin, 1)
        check_positive("lr_factor", self.factor)
        check_bounds("lr_bounds", self.bounds)
        if self.factor <= 1:
            raise ValueError(f"lr_factor must be greater than 1, got {self.factor}.")
        if self.bounds[0] <= 0:
            raise ValueError(f"lr_bounds must be positive, got {self.bounds}.")

    def adapt(self, learning_rate: float, kl: float, desired_kl: float) -> float:
        """The learning rate after ``kl`` nats were measured where ``desired_kl`` were wanted."""
        # Where it starts beyond its bounds, they must not turn "lower" into "higher".
        lowest, highest = min(self.bounds[0], learning_rate), max(self.bounds[1], learning_rate)
        if kl > self.margin * desired_kl:
            return max(learning_rate / self.factor, lowest)
        if kl < desired_kl / self.margin:
            return min(learning_rate * self.factor, highest)
        return learning_rate
