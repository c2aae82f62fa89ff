"""Activations: loops over formulas that the compiler turns into vector instructions.

All come down to one exponential, and differ from torch's by a few units in the last place.
"""

import math
from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.options import F, exact
from sb3_policyflow.kernels.activations import (
    ELU,
    GELU,
    GELU_TANH,
    HARDTANH,
    IDENTITY,
    LEAKY_RELU,
    MISH,
    RELU,
    SILU,
    SOFTPLUS,
    TANH,
)
from sb3_policyflow.kernels.layouts import Floats


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
    """Cephes' polynomial near zero, 1 - 2 / (e^2|x| + 1) elsewhere."""
    square = x * x
    p = F(-5.70498872745e-3)
    p = p * square + F(2.06390887954e-2)
    p = p * square + F(-5.37397155531e-2)
    p = p * square + F(1.33314422036e-1)
    p = p * square + F(-3.33332819422e-1)
    near = p * square * x + x
    far = F(1.0) - F(2.0) / (_exp(F(2.0) * abs(x)) + F(1.0))
    far = -far if x < F(0.0) else far
    return far if abs(x) > F(0.625) else near


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
    """(tanh u, du/dx) with u = sqrt(2 / pi) (x + 0.044715 x^3): gelu(x) ~ x (1 + tanh u) / 2."""
    square = F(0.044715) * x * x
    u = F(0.79788456) * (x + square * x)
    return _tanh(u), F(0.79788456) * (F(1.0) + F(3.0) * square)


@exact
def _softplus(x: Any, beta: Any) -> Any:
    scaled = beta * x
    return x if scaled > F(20.0) else math.log1p(_exp(scaled)) / beta


@exact
def activate(kind: int, alpha: Any, values: Floats) -> None:  # noqa: C901  # one loop for each
    """Apply an activation in place."""
    if kind == MISH:
        for i in range(values.size):
            _, w, inverse = _mish_parts(values[i])
            values[i] *= w * inverse
    elif kind == TANH:
        for i in range(values.size):
            values[i] = _tanh(values[i])
    elif kind == RELU:
        for i in range(values.size):
            values[i] = F(0.0) if values[i] < F(0.0) else values[i]
    elif kind == LEAKY_RELU:
        for i in range(values.size):
            values[i] = alpha * values[i] if values[i] < F(0.0) else values[i]
    elif kind == SILU:
        for i in range(values.size):
            values[i] *= _sigmoid(values[i])
    elif kind == ELU:
        for i in range(values.size):
            values[i] = _elu(values[i], alpha)
    elif kind == GELU:
        for i in range(values.size):
            values[i] *= _normal_cdf(values[i])
    elif kind == GELU_TANH:
        for i in range(values.size):
            values[i] *= F(0.5) + F(0.5) * _gelu_parts(values[i])[0]
    elif kind == SOFTPLUS:
        for i in range(values.size):
            values[i] = _softplus(values[i], alpha)
    elif kind == HARDTANH:
        for i in range(values.size):
            values[i] = F(-1.0) if values[i] < F(-1.0) else values[i]
            values[i] = F(1.0) if values[i] > F(1.0) else values[i]
    elif kind != IDENTITY:
        for i in range(values.size):
            values[i] = _sigmoid(values[i])


@exact
def _rarer_with_derivatives(  # noqa: C901  # one loop for each
    kind: int, alpha: Any, values: Floats, derivatives: Floats
) -> None:
    if kind == GELU:
        for i in range(values.size):
            x = values[i]
            below = _normal_cdf(x)
            derivatives[i] = below + x * F(0.39894228) * _exp(F(-0.5) * x * x)
            values[i] = x * below
    elif kind == GELU_TANH:
        for i in range(values.size):
            x = values[i]
            t, slope = _gelu_parts(x)
            derivatives[i] = F(0.5) * (F(1.0) + t + x * (F(1.0) - t * t) * slope)
            values[i] = x * (F(0.5) + F(0.5) * t)
    elif kind == SOFTPLUS:
        for i in range(values.size):
            scaled = alpha * values[i]
            derivatives[i] = F(1.0) if scaled > F(20.0) else _sigmoid(scaled)
            values[i] = _softplus(values[i], alpha)
    elif kind == HARDTANH:
        for i in range(values.size):
            derivatives[i] = F(1.0) if abs(values[i]) < F(1.0) else F(0.0)
            values[i] = F(-1.0) if values[i] < F(-1.0) else values[i]
            values[i] = F(1.0) if values[i] > F(1.0) else values[i]
    elif kind == IDENTITY:
        for i in range(values.size):
            derivatives[i] = F(1.0)
    else:
        for i in range(values.size):
            values[i] = _sigmoid(values[i])
            derivatives[i] = values[i] * (F(1.0) - values[i])


@exact
def activate_with_derivatives(  # noqa: C901  # one loop for each
    kind: int, alpha: Any, values: Floats, derivatives: Floats
) -> None:
    """Apply an activation in place, and keep its derivatives.

    mish'(x) = w / (w + 2) + 4 x u (u + 1) / (w + 2)^2
    """
    if kind == MISH:
        for i in range(values.size):
            u, w, inverse = _mish_parts(values[i])
            gate = w * inverse
            derivatives[i] = gate + F(4.0) * values[i] * (u * (u + F(1.0)) * inverse) * inverse
            values[i] *= gate
    elif kind == TANH:
        for i in range(values.size):
            values[i] = _tanh(values[i])
            derivatives[i] = F(1.0) - values[i] * values[i]
    elif kind == RELU:
        for i in range(values.size):
            derivatives[i] = F(0.0) if values[i] <= F(0.0) else F(1.0)
            values[i] = F(0.0) if values[i] < F(0.0) else values[i]
    elif kind == LEAKY_RELU:
        for i in range(values.size):
            derivatives[i] = F(1.0) if values[i] > F(0.0) else alpha
            values[i] = alpha * values[i] if values[i] < F(0.0) else values[i]
    elif kind == SILU:
        for i in range(values.size):
            gate = _sigmoid(values[i])
            derivatives[i] = gate * (F(1.0) + values[i] * (F(1.0) - gate))
            values[i] *= gate
    elif kind == ELU:
        for i in range(values.size):
            y = _elu(values[i], alpha)
            derivatives[i] = F(1.0) if values[i] > F(0.0) else y + alpha
            values[i] = y
    else:
        _rarer_with_derivatives(kind, alpha, values, derivatives)
