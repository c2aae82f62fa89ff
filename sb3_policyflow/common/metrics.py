"""Figures about the update, gathered without waiting for the device."""

import torch as th


class UpdateMetrics:
    """Collects tensors for each minibatch and brings them to the host in one transfer.

    >>> metrics = UpdateMetrics()
    >>> metrics.add({"loss": th.tensor(1.0), "log_ratio_max": th.tensor(1.0)})
    >>> metrics.add({"loss": th.tensor(3.0), "log_ratio_max": th.tensor(3.0)})
    >>> metrics.summary()
    {'loss': 2.0, 'log_ratio_max': 3.0}
    """

    def __init__(self) -> None:
        self._values: dict[str, list[th.Tensor]] = {}

    def add(self, metrics: dict[str, th.Tensor]) -> None:
        """Remember the figures of one minibatch, tensors without dimensions."""
        for name, value in metrics.items():
            self._values.setdefault(name, []).append(value.detach())

    def summary(self) -> dict[str, float]:
        """The mean of each figure, or the greatest where its name ends in "_max"."""
        if not self._values:
            return {}
        reduced = [
            th.stack(values).max() if name.endswith("_max") else th.stack(values).mean()
            for name, values in self._values.items()
        ]
        return dict(zip(self._values, th.stack(reduced).tolist(), strict=True))
