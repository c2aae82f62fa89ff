"""Formulas of activations for one number, which the compiler turns into vector instructions.

All come down to one exponential or, for tanh, one division, and differ from torch's by a few units
in the last place.
"""

import math
from typing import Any

import numpy as np

from sb3_policyflow.kernels._numba.options import F, exact


@exact
def exp_parts(x: Any) -> Any:
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
def exp(x: Any) -> Any:
    m, s = exp_parts(x)
    return m * s + s


@exact
def tanh_of(x: Any) -> Any:
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
def sigmoid_of(x: Any) -> Any:
    return F(1.0) / (F(1.0) + exp(-x))


@exact
def elu_of(x: Any, alpha: Any) -> Any:
    m, s = exp_parts(x)
    return x if x > F(0.0) else alpha * (m * s + (s - F(1.0)))


@exact
def mish_parts(x: Any) -> Any:
    """(u, w, 1 / (w + 2)) with u = e^x and w = u (u + 2): mish(x) = x w / (w + 2)."""
    u = exp(F(20.0) if x > F(20.0) else x)
    w = u * (u + F(2.0))
    return u, w, F(1.0) / (w + F(2.0))


@exact
def normal_cdf(x: Any) -> Any:
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
    tail = F(0.5) * t * exp(p * t - F(1.26551223) - z * z)
    return F(1.0) - tail if x > F(0.0) else tail


@exact
def gelu_parts(x: Any) -> Any:
    """(gate, du/dx) with gate = (1 + tanh u) / 2 = sigmoid(2 u) and gelu(x) ~ x gate.

    u = sqrt(2 / pi) (x + 0.044715 x^3)
    """
    square = F(0.044715) * x * x
    u = F(0.79788456) * (x + square * x)
    return sigmoid_of(F(2.0) * u), F(0.79788456) * (F(1.0) + F(3.0) * square)


@exact
def softplus_of(x: Any, beta: Any) -> Any:
    scaled = beta * x
    return x if scaled > F(20.0) else math.log1p(exp(scaled)) / beta
