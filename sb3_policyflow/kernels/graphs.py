"""CUDA graphs: on a GPU, many small operations that are started in one call.

An operation of a small network takes a GPU less time than it takes Python to start it. A graph
records the operations of a function once. A replay reads the tensors that were there then, as they
are now: parameters may change in place.
"""

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Lock
from typing import Any, TypeVar

import torch as th
from torch import nn

from sb3_policyflow.kernels.inspection import KernelView

MAX_GRAPHS = 8
"""Graphs that a field keeps at the same time."""

T = TypeVar("T")


class GraphMemory:
    """Memory for graphs that are replayed one after the other, each in place of the one before.

    Torch frees a graph's memory late. It is shared with the next graph if that is recorded while
    the last one is still there. A copy has no memory.
    """

    def __init__(self) -> None:
        self.is_warm = False
        """Whether the libraries that a graph calls have been called before, as they must be."""
        self._last: th.cuda.CUDAGraph | None = None
        self._stream: Any = None  # one for all, as libraries keep memory for each that they see

    def __reduce__(self) -> Any:
        return type(self), ()

    def record(self, function: Callable[[], T]) -> tuple[th.cuda.CUDAGraph, T]:
        """Record a function as a graph.

        :param function: Starts the same operations on the present device whenever it is called, and
            does not wait for them.
        :return: The graph, and what the function returned. Tensors in it are the graph's: they have
            values after each replay.
        """
        if self._stream is None:
            make_stream: Any = th.cuda.Stream
            self._stream = make_stream()
        graph, stream = th.cuda.CUDAGraph(), self._stream
        stream.wait_stream(th.cuda.current_stream())
        pool = None if self._last is None else self._last.pool()
        with th.cuda.stream(stream), _without_garbage_collection():
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                result = function()
            finally:
                graph.capture_end()
        th.cuda.current_stream().wait_stream(stream)
        self._last = graph
        return graph, result


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """A block in which nothing of CUDA's is destroyed by chance, which would end a recording."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class _Replay:
    """A function of tensors that returns a tensor, as a graph.

    :param function: The function, see :meth:`GraphMemory.record`.
    :param inputs: Tensors like those that it will be given.
    :param memory: That of others which are replayed on the same stream.
    """

    def __init__(
        self,
        function: Callable[..., th.Tensor],
        inputs: Sequence[th.Tensor],
        memory: GraphMemory,
    ) -> None:
        self._inputs = [tensor.clone() for tensor in inputs]
        self._graph, self._output = memory.record(lambda: function(*self._inputs))

    def __call__(self, inputs: Sequence[th.Tensor]) -> th.Tensor:
        th._foreach_copy_(self._inputs, list(inputs))
        self._graph.replay()
        return self._output.clone()


class FlowGraphs:
    """The flow of a velocity field from latents to end points, as graphs.

    There is one for each solver and each shape of latents that has been seen twice. All are
    forgotten when the field has other parts. A copy has none, and threads may share them.

    :param read: Reads the parts of a field, see :class:`~.inspection.KernelView`.
    """

    def __init__(self, read: Callable[..., Any]) -> None:
        self._read = read
        self._view: KernelView[Any] = KernelView(read, "cuda")
        self._parts: object = None
        self._replays: dict[Any, _Replay | None] = {}
        self._memories: dict[Any, GraphMemory] = {}
        self._lock = Lock()

    def __reduce__(self) -> Any:
        return type(self), (self._read,)

    def reason_off(self, field: nn.Module) -> str | None:
        """Why there are none for a field; None if there are.

        :param field: The field.
        """
        parts = self._view.of(field)
        return parts if isinstance(parts, str) else None

    def run(
        self,
        field: nn.Module,
        integrate: Callable[[th.Tensor, th.Tensor], th.Tensor],
        latents: th.Tensor,
        features: th.Tensor,
        method: tuple[Any, ...],
    ) -> th.Tensor | None:
        """End points of the flow, shape (n, dim).

        :param field: The velocity field.
        :param integrate: What a graph records: carries latents and features to end points.
        :param latents: Shape (n, dim).
        :param features: Shape (n, features_dim).
        :param method: What else decides on the operations.
        :return: None where a graph cannot be used, or is not worth it yet.
        """
        inputs = (latents, features)
        if th.is_grad_enabled() or th.is_inference_mode_enabled() or not _are_plain(inputs):
            return None
        parts = self._view.of(field)
        if isinstance(parts, str) or th.cuda.is_current_stream_capturing():
            return None
        shapes = latents.shape, features.shape
        place = latents.device, th.cuda.current_stream(latents.device).cuda_stream
        key = (*method, *shapes, place, th.get_float32_matmul_precision())
        with self._lock, th.cuda.device(latents.device):
            if parts is not self._parts or len(self._replays) >= MAX_GRAPHS:
                self._parts, self._replays = parts, {}
            if key not in self._replays:
                self._replays[key] = None  # perhaps it is only seen once
                return None
            replay = self._replays[key]
            if replay is None:
                memory = self._memories.setdefault(place, GraphMemory())
                replay = self._replays[key] = _Replay(integrate, inputs, memory)
            return replay(inputs)


def _are_plain(inputs: Sequence[th.Tensor]) -> bool:
    return all(
        type(tensor) is th.Tensor and tensor.is_cuda and tensor.dtype is th.float32
        for tensor in inputs
    )
