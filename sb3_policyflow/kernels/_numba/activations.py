"""Activations: loops over :mod:`~.formulas`.

Each is compiled when a network first has it, apart from the kernels, which call it by its address.
"""

from typing import Any

from llvmlite import ir
from numba import types

from sb3_policyflow.kernels._numba.formulas import (
    elu_of,
    exp,
    gelu_parts,
    mish_parts,
    normal_cdf,
    sigmoid_of,
    softplus_of,
    tanh_of,
)
from sb3_policyflow.kernels._numba.options import F, called
from sb3_policyflow.kernels._numba.views import intrinsic, vector
from sb3_policyflow.kernels.activations import (
    ELU,
    GELU,
    GELU_TANH,
    HARDTANH,
    IDENTITY,
    LEAKY_RELU,
    MISH,
    RELU,
    SIGMOID,
    SILU,
    SOFTPLUS,
    TANH,
)


@called
def mish(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    """mish'(x) = w / (w + 2) + 4 x u (u + 1) / (w + 2)^2."""
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            u, w, inverse = mish_parts(x[i])
            gate = w * inverse
            slopes[i] = gate + F(4.0) * x[i] * (u * (u + F(1.0)) * inverse) * inverse
            x[i] *= gate
    else:
        for i in range(size):
            _, w, inverse = mish_parts(x[i])
            x[i] *= w * inverse


@called
def tanh(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            x[i] = tanh_of(x[i])
            slopes[i] = F(1.0) - x[i] * x[i]
    else:
        for i in range(size):
            x[i] = tanh_of(x[i])


@called
def relu(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            slopes[i] = F(0.0) if x[i] <= F(0.0) else F(1.0)
            x[i] = F(0.0) if x[i] < F(0.0) else x[i]
    else:
        for i in range(size):
            x[i] = F(0.0) if x[i] < F(0.0) else x[i]


@called
def leaky_relu(alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            slopes[i] = F(1.0) if x[i] > F(0.0) else alpha
            x[i] = alpha * x[i] if x[i] < F(0.0) else x[i]
    else:
        for i in range(size):
            x[i] = alpha * x[i] if x[i] < F(0.0) else x[i]


@called
def silu(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            gate = sigmoid_of(x[i])
            slopes[i] = gate * (F(1.0) + x[i] * (F(1.0) - gate))
            x[i] *= gate
    else:
        for i in range(size):
            x[i] *= sigmoid_of(x[i])


@called
def elu(alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            y = elu_of(x[i], alpha)
            slopes[i] = F(1.0) if x[i] > F(0.0) else y + alpha
            x[i] = y
    else:
        for i in range(size):
            x[i] = elu_of(x[i], alpha)


@called
def gelu(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            below = normal_cdf(x[i])
            slopes[i] = below + x[i] * F(0.39894228) * exp(F(-0.5) * x[i] * x[i])
            x[i] *= below
    else:
        for i in range(size):
            x[i] *= normal_cdf(x[i])


@called
def gelu_tanh(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            gate, slope = gelu_parts(x[i])
            slopes[i] = gate * (F(1.0) + F(2.0) * x[i] * (F(1.0) - gate) * slope)
            x[i] *= gate
    else:
        for i in range(size):
            x[i] *= gelu_parts(x[i])[0]


@called
def softplus(alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            scaled = alpha * x[i]
            slopes[i] = F(1.0) if scaled > F(20.0) else sigmoid_of(scaled)
            x[i] = softplus_of(x[i], alpha)
    else:
        for i in range(size):
            x[i] = softplus_of(x[i], alpha)


@called
def hardtanh(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            slopes[i] = F(1.0) if abs(x[i]) < F(1.0) else F(0.0)
            x[i] = F(-1.0) if x[i] < F(-1.0) else x[i]
            x[i] = F(1.0) if x[i] > F(1.0) else x[i]
    else:
        for i in range(size):
            x[i] = F(-1.0) if x[i] < F(-1.0) else x[i]
            x[i] = F(1.0) if x[i] > F(1.0) else x[i]


@called
def sigmoid(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            x[i] = sigmoid_of(x[i])
            slopes[i] = x[i] * (F(1.0) - x[i])
    else:
        for i in range(size):
            x[i] = sigmoid_of(x[i])


@called
def identity(_alpha: Any, _values: int, derivatives: int, size: int) -> None:
    slopes = vector(derivatives, size)
    if derivatives:
        for i in range(size):
            slopes[i] = F(1.0)


ACTIVATIONS = {
    RELU: relu,
    LEAKY_RELU: leaky_relu,
    ELU: elu,
    TANH: tanh,
    SIGMOID: sigmoid,
    SILU: silu,
    MISH: mish,
    GELU: gelu,
    GELU_TANH: gelu_tanh,
    SOFTPLUS: softplus,
    HARDTANH: hardtanh,
    IDENTITY: identity,
}
"""Each takes its parameter, and addresses of the values, which it changes, and of the derivatives,
which it fills, or 0 if they are not wanted."""


def activation_address(kind: int) -> int:
    """Where an activation is in memory, compiled.

    :param kind: One of :mod:`sb3_policyflow.kernels.activations`.
    """
    dispatcher = ACTIVATIONS[kind]
    arguments = (types.float32, types.intp, types.intp, types.intp)
    dispatcher.compile(arguments)
    compiled = dispatcher.overloads[arguments]
    address: int = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name)
    return address


@intrinsic
def activate(
    _context: Any, _address: Any, _alpha: Any, _values: Any, _derivatives: Any, _size: Any
) -> Any:
    """Call what is at an address, one of :data:`ACTIVATIONS`."""

    def codegen(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        address, *others = arguments
        kind = ir.FunctionType(ir.VoidType(), [argument.type for argument in others])
        builder.call(builder.inttoptr(address, kind.as_pointer()), others)
        return context.get_dummy_value()

    size = types.intp
    return types.void(size, types.float32, size, size, size), codegen
