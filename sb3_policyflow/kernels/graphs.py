"""CUDA graphs: on a GPU, many small operations that are started in one call.

An operation of a small network takes a GPU less time than it takes Python to start it. A graph
records the operations of a function once, with the places of the tensors that they read and write.
A replay finds the present values there: parameters may change in place, but must not be replaced.
"""

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Any, Generic, TypeVar

import torch as th

from sb3_policyflow.kernels.compiler import SWITCH

MAX_GRAPHS = 8
"""Shapes and solvers that a field remembers at the same time."""

T = TypeVar("T")


class Recording(Generic[T]):
    """A function whose operations have been recorded.

    :param graph: The graph.
    :param device: The GPU.
    :param result: What the function returned: tensors that each replay writes to.
    """

    def __init__(self, graph: th.cuda.CUDAGraph, device: th.device, result: T) -> None:
        self._graph, self._device, self._result = graph, device, result

    def replay(self) -> T:
        """What the function returns now; the next replay of the same memory overwrites it."""
        with th.cuda.device(self._device):
            self._graph.replay()
        return self._result


class GraphMemory:
    """Memory of graphs that are replayed one at a time.

    What a replay has computed must be copied before another graph of the memory is replayed. Torch
    frees a graph's memory late, and shares it with another one that is recorded while the last one
    is still there. A copy has no memory.
    """

    def __init__(self) -> None:
        self.known_sizes: set[int] = set()
        """Sizes of what was computed without a graph, as is needed before the first recording."""
        self._last: th.cuda.CUDAGraph | None = None
        self._stream: Any = None  # one for all, as libraries keep memory for each that they see

    def __reduce__(self) -> Any:
        return type(self), ()

    def record(self, function: Callable[[], T], device: th.device) -> Recording[T]:
        """Record a function, which has been called before.

        :param function: Starts the same operations on the device whenever it is called, and does
            not wait for them.
        :param device: The GPU.
        :raises RuntimeError: If it cannot be recorded, with the cause.
        """
        with th.cuda.device(device), _without_garbage_collection():
            if self._last is None:
                th.cuda.empty_cache()  # which the memory of graphs is no part of
                make_stream: Any = th.cuda.Stream
                self._stream = make_stream()
            graph, pool = th.cuda.CUDAGraph(), None if self._last is None else self._last.pool()
            self._stream.wait_stream(th.cuda.current_stream())
            with th.cuda.stream(self._stream):
                result = _recorded(graph, pool, function)
            th.cuda.current_stream().wait_stream(self._stream)
        self._last = graph
        return Recording(graph, device, result)


def _recorded(graph: th.cuda.CUDAGraph, pool: Any, function: Callable[[], T]) -> T:
    graph.capture_begin(pool=pool, capture_error_mode="thread_local")
    try:
        result = function()
    except BaseException as error:
        with suppress(RuntimeError):  # which would hide the cause
            graph.capture_end()
        if not isinstance(error, Exception):
            raise
        raise RuntimeError(
            f"A CUDA graph could not be recorded ({error}): start again with {SWITCH}=0 in the "
            "environment, which turns graphs off."
        ) from error
    graph.capture_end()
    return result


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
        self._recording = memory.record(lambda: function(*self._inputs), inputs[0].device)

    def __call__(self, inputs: Sequence[th.Tensor]) -> th.Tensor:
        th._foreach_copy_(self._inputs, list(inputs))
        return self._recording.replay().clone()


class FlowGraphs:
    """The flow of a velocity field from latents to end points, as graphs.

    There is one for each solver and each shape of latents that has been seen twice. All are
    forgotten when the field has other parts. A copy has none, and threads may share them.
    """

    def __init__(self) -> None:
        self._parts: object = None
        self._replays: dict[Any, _Replay | None] = {}
        self._memories: dict[Any, GraphMemory] = {}
        self._lock = Lock()

    def __reduce__(self) -> Any:
        return type(self), ()

    def run(
        self,
        parts: object,
        integrate: Callable[[th.Tensor, th.Tensor], th.Tensor],
        latents: th.Tensor,
        features: th.Tensor,
        method: tuple[Any, ...],
    ) -> th.Tensor | None:
        """End points of the flow, shape (n, dim), without gradients.

        :param parts: What the velocity field consists of now.
        :param integrate: What a graph records: carries latents and features to end points.
        :param latents: Shape (n, dim).
        :param features: Shape (n, features_dim).
        :param method: What else decides on the operations.
        :return: None where a graph cannot be used, or is not worth it yet.
        """
        inputs = (latents, features)
        if th.is_inference_mode_enabled() or not _are_plain(inputs):
            return None
        if th.cuda.is_current_stream_capturing():
            return None
        shapes = latents.shape, features.shape
        place = latents.device, th.cuda.current_stream(latents.device).cuda_stream
        key = (*method, *shapes, place, *_modes())
        with self._lock, th.cuda.device(latents.device):
            if parts is not self._parts:
                self._parts, self._replays = parts, {}
            if key not in self._replays:
                if len(self._replays) >= MAX_GRAPHS:
                    self._replays.clear()
                self._replays[key] = None  # perhaps it is only seen once
                return None
            replay = self._replays[key]
            if replay is None:
                memory = self._memories.setdefault(place, GraphMemory())
                replay = self._replays[key] = _Replay(integrate, inputs, memory)
            return replay(inputs)


def _modes() -> tuple[object, ...]:
    """Settings of torch's that decide which operations are started."""
    matmul = th.backends.cuda.matmul
    # Where torch has the newer of the two settings, the other one must not be mixed with it.
    newer = hasattr(matmul, "fp32_precision")
    precision = matmul.fp32_precision if newer else matmul.allow_tf32
    return precision, th.are_deterministic_algorithms_enabled()


def _are_plain(inputs: Sequence[th.Tensor]) -> bool:
    return all(
        type(tensor) is th.Tensor and tensor.is_cuda and tensor.dtype is th.float32
        for tensor in inputs
    )
