"""An update's loss and its gradients as a CUDA graph, on a GPU."""

from collections.abc import Callable, Iterable
from typing import Any

import torch as th

from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.tree import map_tensors, tensors
from sb3_policyflow.common.update import CompiledTerms, FlowUpdate, Loss, UpdateMetrics
from sb3_policyflow.kernels import GraphMemory, reason_graphs_are_off

Evaluate = Callable[[FlowRolloutBufferSamples, UpdateMetrics], tuple[Loss, th.Tensor]]
"""Returns the loss of a minibatch and its divergence, see :meth:`~.update.FlowUpdate.loss`."""


def record_losses(update: FlowUpdate) -> None:
    """Let an update evaluate its minibatches by a graph, where that can be.

    :param update: The update.
    """
    policy = update.policy
    is_known = update.has_known_formulas and type(update).loss is FlowUpdate.loss
    if is_known and policy.device.type == "cuda" and reason_graphs_are_off(policy) is None:
        update.recorded_loss = LossGraph(
            update.loss, policy.parameters(), update.batch_size, policy.graph_memory
        )


class LossGraph:
    """Evaluates the minibatches of one update.

    The first one of a full size is recorded, with its backward pass, and the others are replays.
    What the loss takes from elsewhere must stay where it is: parameters change in place, and an
    update's own numbers do not change.

    :param evaluate: The loss, as formulas.
    :param parameters: What is differentiated by.
    :param size: Samples in a minibatch of full size.
    :param memory: That of the updates before.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        parameters: Iterable[th.nn.Parameter],
        size: int,
        memory: GraphMemory,
    ) -> None:
        self._evaluate, self._size, self._memory = evaluate, size, memory
        self._parameters = [parameter for parameter in parameters if parameter.requires_grad]
        self._graph: th.cuda.CUDAGraph | None = None
        self._batch: FlowRolloutBufferSamples
        self._recorded: _Evaluated

    def __call__(self, batch: FlowRolloutBufferSamples) -> CompiledTerms:
        """Loss, gradients and metrics of a minibatch."""
        if len(batch.actions) != self._size or not self._memory.is_warm:
            self._memory.is_warm = True
            return self._evaluated(batch).terms()
        if self._graph is None:
            self._batch = map_tensors(th.clone, batch)
            self._graph, self._recorded = self._memory.record(lambda: self._evaluated(self._batch))
        else:
            th._foreach_copy_(list(tensors(self._batch)), list(tensors(batch)))
        self._graph.replay()
        return self._recorded.terms()

    def _evaluated(self, batch: FlowRolloutBufferSamples) -> "_Evaluated":
        """What is recorded. Nothing is left of autograd's, which remembers the stream it was on."""
        for parameter in self._parameters:
            parameter.grad = None
        metrics = UpdateMetrics()
        loss, kl = self._evaluate(batch, metrics)
        loss.backward()
        evaluated = _Evaluated(loss, kl, metrics, self._parameters)
        for parameter in self._parameters:
            parameter.grad = None
        return evaluated


class _Evaluated:
    """A minibatch's loss, divergence and metrics as one tensor, and its gradients.

    :param loss: The loss, whose gradients have been computed.
    :param kl: The divergence.
    :param metrics: The metrics.
    :param parameters: Have the gradients.
    """

    def __init__(
        self,
        loss: Any,
        kl: th.Tensor,
        metrics: UpdateMetrics,
        parameters: Iterable[th.nn.Parameter],
    ) -> None:
        means, maxima = metrics.last()
        self._names = list(means), list(maxima)
        self._numbers = th.stack([loss.detach(), kl, *means.values(), *maxima.values()])
        self._gradients = [(parameter, parameter.grad) for parameter in parameters]

    def terms(self) -> CompiledTerms:
        """What the update takes; its numbers are copies, which the next replay leaves alone."""
        loss, kl, *numbers = self._numbers.clone().unbind()
        means, maxima = self._names
        return CompiledTerms(
            GraphedLoss(loss, self._gradients),
            kl,
            dict(zip(means, numbers[: len(means)], strict=True)),
            dict(zip(maxima, numbers[len(means) :], strict=True)),
        )


class GraphedLoss:
    """A loss whose gradients are there already: a :class:`~.update.Loss`.

    :param value: The loss, a tensor without dimensions.
    :param gradients: Parameters with their gradients, or None where they have none.
    """

    def __init__(
        self, value: th.Tensor, gradients: list[tuple[th.nn.Parameter, th.Tensor | None]]
    ) -> None:
        self._value, self._gradients = value, gradients

    def item(self) -> float:
        """Its value."""
        return self._value.item()

    def backward(self, *, inputs: Any = None) -> None:
        """Give the parameters their gradients; those in ``inputs`` only, if they are given."""
        chosen = None if inputs is None else set(inputs)
        for parameter, gradient in self._gradients:
            if chosen is None or parameter in chosen:
                parameter.grad = gradient
