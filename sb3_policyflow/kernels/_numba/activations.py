"""Activations: loops over formulas that the compiler turns into vector instructions.

All come down to one exponential or, for tanh, one division, and differ from torch's by a few units
in the last place. Each is compiled when a network first has it, apart from the kernels, which call
it by its address.
"""

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

from sb3_policyflow.kernels._numba.options import F, called, exact
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


@exact
def _exp_parts(x: Any) -> Any:
    """(m, s) with e^x = s (1 + m), where s is a power of two and |m| < 0.42; NaN stays NaN.

    The polynomial is that of Cephes' expf.
    """
    x = F(88.0) if x > F(88.0) else x
    x = F(-87.0) if x < F(-87.0) else x
    n = np.floor(x * F(1.44269504) + F(0.5))
    r = (x - n * F(0.693359375)) - n * F(-2.12194440e-4)
    p = F(1.9875691500e-4)
    p = p * r + F(1.3981999507e-3)
    p = p * r + F(8.3334519073e-3)
    p = p * r + F(4.1665795894e-2)
    p = p * r + F(1.6666665459e-1)
    p = p * r + F(5.0000001201e-1)
    scale = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return p * (r * r) + r, scale


@exact
def _exp(x: Any) -> Any:
    m, s = _exp_parts(x)
    return m * s + s


@exact
def _tanh(x: Any) -> Any:
    """X P(x^2) / Q(x^2), fitted up to x = 9 and 1 beyond: within five units in the last place.

    With an exponential it would take twice as long. 1 - tanh(x)^2 is off by 6e-7 at most.
    """
    x = F(9.0) if x > F(9.0) else x
    x = F(-9.0) if x < F(-9.0) else x
    square = x * x
    p = F(1.33546481e-8)
    p = p * square + F(2.06090717e-5)
    p = p * square + F(3.49558727e-3)
    p = p * square + F(1.33810252e-1)
    p = p * square + F(1.0)
    q = F(7.77655259e-7)
    q = q * square + F(3.28563357e-4)
    q = q * square + F(2.58769784e-2)
    q = q * square + F(4.67143416e-1)
    q = q * square + F(1.0)
    y = x * p / q
    y = F(1.0) if y > F(1.0) else y
    return F(-1.0) if y < F(-1.0) else y


@exact
def _sigmoid(x: Any) -> Any:
    return F(1.0) / (F(1.0) + _exp(-x))


@exact
def _elu(x: Any, alpha: Any) -> Any:
    m, s = _exp_parts(x)
    return x if x > F(0.0) else alpha * (m * s + (s - F(1.0)))


@exact
def _mish_parts(x: Any) -> Any:
    """(u, w, 1 / (w + 2)) with u = e^x and w = u (u + 2): mish(x) = x w / (w + 2)."""
    u = _exp(F(20.0) if x > F(20.0) else x)
    w = u * (u + F(2.0))
    return u, w, F(1.0) / (w + F(2.0))


@exact
def _normal_cdf(x: Any) -> Any:
    """erfc(-x / sqrt(2)) / 2, with the Chebyshev fit of erfc in Numerical Recipes (1.2e-7)."""
    z = abs(x) * F(0.70710678)
    t = F(1.0) / (F(1.0) + F(0.5) * z)
    p = t * F(0.17087277) - F(0.82215223)
    p = p * t + F(1.48851587)
    p = p * t - F(1.13520398)
    p = p * t + F(0.27886807)
    p = p * t - F(0.18628806)
    p = p * t + F(0.09678418)
    p = p * t + F(0.37409196)
    p = p * t + F(1.00002368)
    tail = F(0.5) * t * _exp(p * t - F(1.26551223) - z * z)
    return F(1.0) - tail if x > F(0.0) else tail


@exact
def _gelu_parts(x: Any) -> Any:
    """(gate, du/dx) with gate = (1 + tanh u) / 2 = sigmoid(2 u) and gelu(x) ~ x gate.

    u = sqrt(2 / pi) (x + 0.044715 x^3)
    """
    square = F(0.044715) * x * x
    u = F(0.79788456) * (x + square * x)
    return _sigmoid(F(2.0) * u), F(0.79788456) * (F(1.0) + F(3.0) * square)


@exact
def _softplus(x: Any, beta: Any) -> Any:
    scaled = beta * x
    return x if scaled > F(20.0) else math.log1p(_exp(scaled)) / beta


@called
def mish(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    """mish'(x) = w / (w + 2) + 4 x u (u + 1) / (w + 2)^2."""
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            u, w, inverse = _mish_parts(x[i])
            gate = w * inverse
            slopes[i] = gate + F(4.0) * x[i] * (u * (u + F(1.0)) * inverse) * inverse
            x[i] *= gate
    else:
        for i in range(size):
            _, w, inverse = _mish_parts(x[i])
            x[i] *= w * inverse


@called
def tanh(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            x[i] = _tanh(x[i])
            slopes[i] = F(1.0) - x[i] * x[i]
    else:
        for i in range(size):
            x[i] = _tanh(x[i])


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
            gate = _sigmoid(x[i])
            slopes[i] = gate * (F(1.0) + x[i] * (F(1.0) - gate))
            x[i] *= gate
    else:
        for i in range(size):
            x[i] *= _sigmoid(x[i])


@called
def elu(alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            y = _elu(x[i], alpha)
            slopes[i] = F(1.0) if x[i] > F(0.0) else y + alpha
            x[i] = y
    else:
        for i in range(size):
            x[i] = _elu(x[i], alpha)


@called
def gelu(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            below = _normal_cdf(x[i])
            slopes[i] = below + x[i] * F(0.39894228) * _exp(F(-0.5) * x[i] * x[i])
            x[i] *= below
    else:
        for i in range(size):
            x[i] *= _normal_cdf(x[i])


@called
def gelu_tanh(_alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            gate, slope = _gelu_parts(x[i])
            slopes[i] = gate * (F(1.0) + F(2.0) * x[i] * (F(1.0) - gate) * slope)
            x[i] *= gate
    else:
        for i in range(size):
            x[i] *= _gelu_parts(x[i])[0]


@called
def softplus(alpha: Any, values: int, derivatives: int, size: int) -> None:
    x, slopes = vector(values, size), vector(derivatives, size)
    if derivatives:
        for i in range(size):
            scaled = alpha * x[i]
            slopes[i] = F(1.0) if scaled > F(20.0) else _sigmoid(scaled)
            x[i] = _softplus(x[i], alpha)
    else:
        for i in range(size):
            x[i] = _softplus(x[i], alpha)


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
            x[i] = _sigmoid(x[i])
            slopes[i] = x[i] * (F(1.0) - x[i])
    else:
        for i in range(size):
            x[i] = _sigmoid(x[i])


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
