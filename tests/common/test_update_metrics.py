"""Metrics of an update: means, and maxima, of its minibatches."""

import pytest
import torch as th

from sb3_policyflow.common.update import UpdateMetrics


def test_means_and_maxima_over_minibatches() -> None:
    metrics = UpdateMetrics()
    for loss, ratio in [(1.0, 3.0), (2.0, 5.0), (6.0, 4.0)]:
        metrics.add_means({"loss": th.tensor(loss), "ratio_mean": th.tensor(ratio)})
        metrics.add_maxima({"ratio_max": th.tensor(ratio)})
    assert metrics.summary() == {"loss": 3.0, "ratio_mean": 4.0, "ratio_max": 5.0}


def test_the_method_says_how_and_not_the_name() -> None:
    metrics = UpdateMetrics()
    for value in (1.0, 2.0):
        metrics.add_means({"at_max": th.tensor(value)})
        metrics.add_maxima({"loss": th.tensor(value)})
    assert metrics.summary() == {"at_max": 1.5, "loss": 2.0}


def test_a_metric_of_some_minibatches_is_the_mean_of_those() -> None:
    metrics = UpdateMetrics()
    metrics.add_means({"always": th.tensor(1.0), "rarely": th.tensor(8.0)})
    metrics.add_means({"always": th.tensor(3.0)})
    assert metrics.summary() == {"always": 2.0, "rarely": 8.0}


def test_nothing_was_added() -> None:
    assert UpdateMetrics().summary() == {}


def test_no_graph_is_kept() -> None:
    metrics = UpdateMetrics()
    weight = th.ones((), requires_grad=True)
    loss = weight.square()
    metrics.add_means({"loss": loss})
    metrics.add_maxima({"greatest": loss})
    loss.backward()  # type: ignore[no-untyped-call]
    summary = metrics.summary()
    assert summary == {"loss": 1.0, "greatest": 1.0}
    assert all(type(value) is float for value in summary.values())


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_not_hidden(number: float) -> None:
    metrics = UpdateMetrics()
    for value in (1.0, number):
        metrics.add_means({"mean": th.tensor(value)})
        metrics.add_maxima({"max": th.tensor(value)})
    for value in metrics.summary().values():
        assert value == pytest.approx(number, nan_ok=True)


def test_metrics_of_many_minibatches_are_all_counted() -> None:
    metrics, values = UpdateMetrics(), th.rand(101)
    for value in values:
        metrics.add_means({"loss": value})
        metrics.add_maxima({"largest": value})
    found = metrics.summary()
    assert found == {"loss": values.mean().item(), "largest": values.max().item()}
