"""Which modules the kernels can work on, and where their parameters are."""

from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch as th
from torch import nn

from sb3_policyflow.flows.folding import HOOKS, has_hooks
from sb3_policyflow.kernels.activations import PLAIN, WITH_ALPHA, Activation
from sb3_policyflow.kernels.compiler import load_kernels, note_fallback
from sb3_policyflow.kernels.layouts import Integers, Kernels


class UnsupportedError(Exception):
    """The kernels cannot work on a module; the message says why, as a part of a sentence."""


class Layer(NamedTuple):
    """The parameters of a linear layer: shapes (n_out, n_in) and (n_out,)."""

    weight: th.Tensor
    bias: th.Tensor


class ModuleInspector:
    """Reads parameters from modules, and remembers where from."""

    def __init__(self) -> None:
        self._hooks: list[Any] = []
        self._places: list[tuple[Any, str, object]] = []

    def is_current(self) -> bool:
        """Whether all that was read would be read again.

        It is asked at every call, so it is the shortest of loops over dictionaries.
        """
        if any(self._hooks):
            return False
        for place, name, thing in self._places:  # noqa: SIM110  # all() takes twice as long
            if place.get(name) is not thing:
                return False
        return True

    def require_no_hooks(self, *modules: nn.Module) -> None:
        """Refuse modules that do more than their own computation.

        :raises UnsupportedError: If one has hooks, or a ``forward`` of its own.
        """
        for module in modules:
            if has_hooks(module):
                raise UnsupportedError(f"{type(module).__name__} has hooks")
            self._hooks += [getattr(module, name) for name in HOOKS]
            self._places.append((module.__dict__, "forward", None))

    def child(self, module: nn.Module, name: str) -> Any:
        """A module within a module."""
        child = module._modules[name]
        self._places.append((module._modules, name, child))
        return child

    def children(self, module: nn.Module) -> list[Any]:
        """All modules within a module."""
        return [self.child(module, name) for name in module._modules]

    def parameter(self, module: nn.Module, name: str) -> Any:
        """A parameter of a module."""
        parameter = module._parameters[name]
        self._places.append((module._parameters, name, parameter))
        return parameter

    def layer(self, module: nn.Module) -> Layer:
        """The parameters of a module that is nothing but linear.

        :raises UnsupportedError: If it is something else, or has no bias.
        """
        if type(module) is not nn.Linear:
            raise UnsupportedError(f"{type(module).__name__} takes the place of a linear layer")
        self.require_no_hooks(module)
        parameters = module._parameters
        weight, bias = parameters.get("weight"), parameters.get("bias")
        if weight is None or bias is None:
            raise UnsupportedError("a linear layer has no weight or no bias of its own")
        self._places += [(parameters, "weight", weight), (parameters, "bias", bias)]
        return Layer(weight, bias)

    def activation(self, module: nn.Module) -> Activation:
        """An activation as the kernels know it.

        >>> ModuleInspector().activation(nn.ELU(0.5))
        Activation(kind=2, alpha=0.5)

        :raises UnsupportedError: If they do not.
        """
        self.require_no_hooks(module)
        if type(module) in PLAIN:
            return PLAIN[type(module)]
        if type(module) not in WITH_ALPHA:
            known = ", ".join(kind.__name__ for kind in (*PLAIN, *WITH_ALPHA))
            raise UnsupportedError(f"activation {type(module).__name__} is not among {known}")
        kind, name = WITH_ALPHA[type(module)]
        alpha = module.__dict__[name]
        self._places.append((module.__dict__, name, alpha))
        return Activation(kind, float(alpha))


class Parts(Protocol):
    """What a module consists of."""

    kernels: Kernels
    """The kernels that work on it."""
    tensors: list[th.Tensor]
    """All tensors that its outputs depend on."""
    shapes: list[th.Size]
    """Their shapes when they were read."""


P = TypeVar("P", bound=Parts)


class KernelView(Generic[P]):
    """Answers whether kernels can work on a module now, and what there is to work on.

    The module is read again when it has changed. Values of parameters are not part of that; the
    tensors are. A copy of a view is an empty one, so that what holds it can be copied and pickled.

    :param read: Reads a module for these kernels, or raises :class:`UnsupportedError`.
    """

    def __init__(self, read: Callable[[Kernels, ModuleInspector, Any], P]) -> None:
        self._read = read
        self._inspector = ModuleInspector()
        self._module: object = None
        self._parts: P | None = None

    def __reduce__(self) -> Any:
        return type(self), (self._read,)

    def of(self, module: Any) -> P | str:
        """The parts of a module as it is now, or the reason why kernels cannot work on it."""
        if not is_eager():
            return "it is being compiled, exported or traced"
        kernels = load_kernels()
        found = kernels if isinstance(kernels, str) else self._current_parts(kernels, module)
        if isinstance(found, str):
            note_fallback(found)
        return found

    def _current_parts(self, kernels: Kernels, module: Any) -> P | str:
        parts = self._parts
        if parts is None or module is not self._module or not self._inspector.is_current():
            self._module, self._inspector, self._parts = module, ModuleInspector(), None
            try:
                parts = self._parts = self._read(kernels, self._inspector, module)
            except UnsupportedError as unsupported:
                return str(unsupported)
        # Setting parameter.data can change all of a tensor and leave it the same object.
        if not (has_same_shapes(parts.tensors, parts.shapes) and are_usable(parts.tensors)):
            return why_unusable(parts.tensors)
        return parts


def is_eager() -> bool:
    """Whether tensors have values, which they have not for those who compile, export or trace."""
    return not th.compiler.is_compiling() and th._C._get_tracing_state() is None


def has_values() -> bool:
    """Whether tensors have values: not while compiling, exporting or tracing, nor in torch.func."""
    return is_eager() and th._C._functorch.peek_interpreter_stack() is None


def has_same_shapes(tensors: Iterable[th.Tensor], shapes: list[th.Size]) -> bool:
    """Whether tensors have the shapes that they were read in."""
    return [tensor.shape for tensor in tensors] == shapes


def are_usable(tensors: Iterable[th.Tensor]) -> bool:
    """Whether kernels can work on these tensors: contiguous float32 on the CPU."""
    for tensor in tensors:
        if tensor.dtype is not th.float32 or not tensor.is_cpu or not tensor.is_contiguous():
            return False
    # Within torch.func's transformations tensors stand for others, and autocast wants another type.
    is_transformed = th._C._functorch.peek_interpreter_stack() is not None
    return not (is_transformed or th.is_autocast_enabled("cpu"))


def why_unusable(tensors: Iterable[th.Tensor]) -> str:
    """The reason why kernels cannot work on parameters: see :func:`are_usable`."""
    for tensor in tensors:
        if not tensor.is_cpu:
            return f"the policy is on {tensor.device.type}"
        if tensor.dtype is not th.float32:
            return f"parameters are {tensor.dtype}, not torch.float32"
        if not tensor.is_contiguous():
            return "parameters are not contiguous"
    return "parameters have changed their shapes, or torch.func or autocast is at work"


def addresses(tensors: Iterable[th.Tensor]) -> Integers:
    """Where tensors start in memory."""
    return np.array([tensor.data_ptr() for tensor in tensors])
