"""An update's loss and its gradients as a CUDA graph, on a GPU."""

from collections.abc import Callable, Iterable
from typing import Any
from weakref import WeakMethod

import torch as th

from sb3_policyflow.common.minibatches import FlowRolloutBufferSamples
from sb3_policyflow.common.tree import map_tensors, tensors
from sb3_policyflow.common.update import EvaluatedTerms, FlowUpdate, Loss, UpdateMetrics
from sb3_policyflow.kernels import GraphMemory, Recording, reason_graphs_are_off

Evaluate = Callable[[FlowRolloutBufferSamples, UpdateMetrics], tuple[Loss, th.Tensor]]
"""Returns the loss of a minibatch and its divergence, see :meth:`~.update.FlowUpdate.loss`."""


def record_losses(algorithm: Any, update: FlowUpdate) -> None:
    """Let an update evaluate its minibatches by a graph, where that can be.

    :param algorithm: The algorithm, whose steps must be the package's own.
    :param update: Its update.
    """
    policy = update.policy
    has_own_steps = type(algorithm)._optimize.__module__.startswith("sb3_policyflow.")
    is_known = has_own_steps and update.may_be_recorded and type(update).loss is FlowUpdate.loss
    if is_known and policy.device.type == "cuda" and reason_graphs_are_off(policy) is None:
        update.recorded_loss = LossGraph(
            update.loss, list(policy.parameters()), update.batch_size, policy.graph_memory
        )


class LossGraph:
    """Evaluates the minibatches of one update.

    The first one of a full size is recorded, with its backward pass, and the others are replays.
    What the loss takes from elsewhere must stay where it is: parameters change in place, and an
    update's own numbers do not change. If parameters are replaced, nothing is recorded any more.

    :param evaluate: The loss, a method of the update, which need not outlive it.
    :param parameters: The policy's.
    :param size: Samples in a minibatch of full size.
    :param memory: That of the updates before.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        parameters: list[th.nn.Parameter],
        size: int,
        memory: GraphMemory,
    ) -> None:
        # The update has this graph: with the update in it, both would wait for a collection.
        self._evaluate = WeakMethod(evaluate)
        self._parameters, self._size, self._memory = parameters, size, memory
        self._places = self._present_places()
        self._recording: Recording[_Evaluated] | None = None
        self._batch: FlowRolloutBufferSamples

    def __call__(self, batch: FlowRolloutBufferSamples) -> EvaluatedTerms:
        """Loss, gradients and metrics of a minibatch."""
        is_known = len(batch.actions) == self._size and self._places == self._present_places()
        if not is_known or self._size not in self._memory.known_sizes:
            self._memory.known_sizes.add(len(batch.actions))
            return self._evaluated(batch).terms()
        if self._recording is None:
            self._batch = map_tensors(th.clone, batch)
            device = self._parameters[0].device
            self._recording = self._memory.record(lambda: self._evaluated(self._batch), device)
        else:
            th._foreach_copy_(list(tensors(self._batch)), list(tensors(batch)))
        return self._recording.replay().terms()

    def _present_places(self) -> list[tuple[int, bool]]:
        """Where the parameters are, and which of them learn."""
        return [(parameter.data_ptr(), parameter.requires_grad) for parameter in self._parameters]

    def _evaluated(self, batch: FlowRolloutBufferSamples) -> "_Evaluated":
        """What is recorded. Nothing is left of autograd's, which remembers the stream it was on."""
        for parameter in self._parameters:
            parameter.grad = None
        metrics, evaluate = UpdateMetrics(), self._evaluate()
        assert evaluate is not None, "an update's minibatches were evaluated behind its end"
        loss, kl = evaluate(batch, metrics)
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

    def terms(self) -> EvaluatedTerms:
        """What the update takes; its numbers are copies, which the next replay leaves alone."""
        loss, kl, *numbers = self._numbers.clone().unbind()
        means, maxima = self._names
        return EvaluatedTerms(
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
        """Add the gradients to those of the parameters; of ``inputs`` only, if they are given.

        A parameter without gradient gets one that the next replay overwrites.
        """
        chosen = None if inputs is None else set(inputs)
        for parameter, gradient in self._gradients:
            if gradient is None or (chosen is not None and parameter not in chosen):
                continue
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
