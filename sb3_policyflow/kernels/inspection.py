"""Which modules the kernels can work on, and where their parameters are."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch as th
from torch import nn
from torch.utils._device import DeviceContext

from sb3_policyflow.flows.folding import GLOBAL_HOOKS, HOOKS, has_hooks
from sb3_policyflow.kernels.activations import KNOWN, Activation
from sb3_policyflow.kernels.compiler import load_kernels, note_fallback
from sb3_policyflow.kernels.layouts import Integers, Kernels

TORCHS_OWN = (th.Tensor, nn.Parameter)
"""Classes of tensors whose numbers are where they say, and who have no functions of their own."""


class UnsupportedError(Exception):
    """The kernels cannot work on a module; the message says why, as a part of a sentence."""


class Layer(NamedTuple):
    """The parameters of a linear layer: shapes (n_out, n_in) and (n_out,)."""

    weight: th.Tensor
    bias: th.Tensor


class ModuleInspector:
    """Reads parameters from modules, and remembers where from.

    :param device: Type of the device that parameters must be on.
    """

    def __init__(self, device: str = "cpu") -> None:
        self._device = device
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

    def sequence(self, module: nn.Module, name: str) -> list[Any]:
        """What is in an ``nn.Sequential`` within a module.

        :raises UnsupportedError: If it is a module of another class, or has hooks.
        """
        sequence = self.child(module, name)
        if type(sequence) is not nn.Sequential:
            raise UnsupportedError(f"{type(sequence).__name__} takes the place of a sequence")
        self.require_no_hooks(sequence)
        return self.children(sequence)

    def require_method(self, module: nn.Module, name: str, method: object) -> None:
        """Refuse a module whose method is another one than that of its known class.

        :raises UnsupportedError: If it is.
        """
        if getattr(type(module), name, None) is not method or name in vars(module):
            raise UnsupportedError(f"{type(module).__name__} has a {name} of its own")
        self._places.append((vars(module), name, None))

    def parameter(self, module: nn.Module, name: str) -> Any:
        """A parameter of a module."""
        parameter: Any = module._parameters[name]
        self._places.append((module._parameters, name, parameter))
        require_usable(parameter, device=self._device)
        return parameter

    def layer(self, module: nn.Module) -> Layer:
        """The parameters of a module that is nothing but linear.

        :raises UnsupportedError: If it is something else, has no bias, or has parameters that
            kernels cannot work on.
        """
        if type(module) is not nn.Linear:
            raise UnsupportedError(f"{type(module).__name__} takes the place of a linear layer")
        self.require_no_hooks(module)
        parameters = module._parameters
        weight, bias = parameters.get("weight"), parameters.get("bias")
        if weight is None or bias is None:
            raise UnsupportedError("a linear layer has no weight or no bias of its own")
        self._places += [(parameters, "weight", weight), (parameters, "bias", bias)]
        require_usable(weight, bias, device=self._device)
        return Layer(weight, bias)

    def activation(self, module: nn.Module) -> Activation:
        """An activation as the kernels know it.

        >>> ModuleInspector().activation(nn.ELU(0.5))
        Activation(kind=2, alpha=0.5)

        :raises UnsupportedError: If they do not.
        """
        self.require_no_hooks(module)
        if type(module) not in KNOWN:
            names = ", ".join(kind.__name__ for kind in KNOWN)
            raise UnsupportedError(f"activation {type(module).__name__} is not among {names}")
        attributes, read = KNOWN[type(module)]
        values = [module.__dict__[name] for name in attributes]
        self._places += [
            (module.__dict__, name, value) for name, value in zip(attributes, values, strict=True)
        ]
        activation = read(*values)
        if activation is None:
            raise UnsupportedError(f"activation {module} has other options than torch's defaults")
        return activation


def have_hooks(parameters: Iterable[th.Tensor]) -> bool:
    """Whether anything watches or changes the gradients of some parameters."""
    return any(p._backward_hooks or p._post_accumulate_grad_hooks for p in parameters)


class Parts(Protocol):
    """What a module consists of, as it was at one moment; nothing of it changes."""

    tensors: list[th.Tensor]
    """All tensors that its outputs depend on."""
    shapes: list[th.Size]
    """Their shapes when they were read."""
    places: list[int]
    """Where they were then. The parts hold on to this memory."""


P = TypeVar("P", bound=Parts)


@dataclass(frozen=True)
class _Reading(Generic[P]):
    """What was read from a module, complete: threads see all of it or nothing."""

    module: object
    inspector: ModuleInspector
    parts: P

    def is_current(self, module: object) -> bool:
        """Whether the module, if it is this one, would be read like this again."""
        if module is not self.module or not self.inspector.is_current():
            return False
        # Setting parameter.data can change all of a tensor and leave it the same object.
        tensors = self.parts.tensors
        if [tensor.data_ptr() for tensor in tensors] != self.parts.places:
            return False
        for tensor in tensors:
            if tensor.dtype is not th.float32 or not tensor.is_contiguous():
                return False
        return [tensor.shape for tensor in tensors] == self.parts.shapes


class KernelView(Generic[P]):
    """Answers whether kernels can work on a module now, and what there is to work on.

    The module is read again when it has changed. Values of parameters are not part of that; the
    tensors are. A copy of a view is an empty one, so that what holds it can be copied and pickled.

    Threads may share a view: it changes by one assignment of a reading that is complete.

    :param read: Reads a module for these kernels, or raises :class:`UnsupportedError`.
    :param device: Type of the device that the module must be on.
    """

    def __init__(
        self, read: Callable[[Kernels, ModuleInspector, Any], P], device: str = "cpu"
    ) -> None:
        self._read, self._device = read, device
        self._reading: _Reading[P] | None = None

    def __reduce__(self) -> Any:
        return type(self), (self._read, self._device)

    def of(self, module: Any) -> P | str:
        """The parts of a module as it is now, or the reason why kernels cannot work on it."""
        kernels = why_torch_must_work(self._device) or load_kernels()
        if isinstance(kernels, str):
            note_fallback(kernels)
            return kernels
        reading = self._reading
        if reading is None or not reading.is_current(module):
            inspector = ModuleInspector(self._device)
            try:
                parts = self._read(kernels, inspector, module)
            except UnsupportedError as unsupported:
                self._reading = None  # which holds memory
                note_fallback(str(unsupported))
                return str(unsupported)
            reading = self._reading = _Reading(module, inspector, parts)
        return reading.parts


def why_torch_must_work(device: str = "cpu") -> str | None:
    """The reason why no kernel can take the place of torch's functions now, whatever the module.

    :param device: Type of the device that the module is on.
    """
    # Tensors have no values for those who compile, export or trace.
    if th.compiler.is_compiling() or th._C._get_tracing_state() is not None:
        return "it is being compiled, exported or traced"
    # Within torch.func's transformations tensors stand for others, and autocast wants another type.
    if th._C._functorch.peek_interpreter_stack() is not None or th.is_autocast_enabled(device):
        return "torch.func or autocast is at work"
    if any(GLOBAL_HOOKS):
        return "there are hooks for all modules"
    if th._C._len_torch_dispatch_stack() or (th._C._len_torch_function_stack() and _is_watched()):
        return "a mode takes part in torch's functions"
    return None


def _is_watched() -> bool:
    """Whether torch's functions have a mode; that of the default device changes no tensor."""
    modes = range(th._C._len_torch_function_stack())
    return any(type(th._C._get_function_stack_at(i)) is not DeviceContext for i in modes)


def are_in_mode(module: nn.Module, training: bool) -> bool:
    """Whether a module and all its parts are in training mode, or all in evaluation mode.

    :param module: The module.
    :param training: The mode that is asked for.
    """
    parts: list[nn.Module | None] = [module]
    for part in parts:  # grows; much faster than Module.modules()
        if part is not None:
            if part.training is not training:
                return False
            if part._modules:
                parts += part._modules.values()
    return True


def has_values() -> bool:
    """Whether tensors have values: not while compiling, exporting or tracing, nor in torch.func."""
    is_traced = th.compiler.is_compiling() or th._C._get_tracing_state() is not None
    return not is_traced and th._C._functorch.peek_interpreter_stack() is None


def are_usable(tensors: Iterable[th.Tensor]) -> bool:
    """Whether kernels can work on these tensors: torch's own, contiguous float32 on the CPU."""
    for tensor in tensors:
        if type(tensor) not in TORCHS_OWN:
            return False
        if tensor.dtype is not th.float32 or not tensor.is_cpu or not tensor.is_contiguous():
            return False
    return True


def require_usable(*tensors: th.Tensor, device: str = "cpu") -> None:
    """Refuse tensors that kernels cannot work on.

    :param device: Type of the device that they must be on.
    :raises UnsupportedError: If there is one, see :func:`are_usable`, or one of another class,
        which may have no memory of its own.
    """
    for tensor in tensors:
        if type(tensor) not in TORCHS_OWN:
            raise UnsupportedError(f"a {type(tensor).__name__} takes the place of a parameter")
        if tensor.device.type != device:
            raise UnsupportedError(f"the policy is on {tensor.device.type}")
        if tensor.dtype is not th.float32:
            raise UnsupportedError(f"parameters are {tensor.dtype}, not torch.float32")
        if not tensor.is_contiguous():
            raise UnsupportedError("parameters are not contiguous")


def addresses(tensors: Iterable[th.Tensor]) -> Integers:
    """Where tensors start in memory."""
    return np.array([tensor.data_ptr() for tensor in tensors])
