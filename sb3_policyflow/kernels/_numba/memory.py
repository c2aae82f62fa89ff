"""Parameters and gradients where they are in memory."""

import math

import numpy as np

from sb3_policyflow.kernels._numba.options import F, kernel
from sb3_policyflow.kernels._numba.views import bits, vector
from sb3_policyflow.kernels.layouts import AdamOptions, Integers

FLOAT32_MAX = float(np.finfo(np.float32).max)


@kernel
def are_same(addresses: Integers, others: Integers, sizes: Integers) -> bool:
    """Whether the numbers at some addresses have the bits of those at others."""
    for place in range(addresses.size):
        numbers = bits(addresses[place], sizes[place])
        other_numbers = bits(others[place], sizes[place])
        difference = np.int32(0)
        for i in range(numbers.size):
            difference |= numbers[i] ^ other_numbers[i]
        if difference != 0:
            return False
    return True


@kernel
def clip(addresses: Integers, sizes: Integers, max_norm: float) -> float:
    """Scale the numbers at some addresses to a Euclidean norm, if theirs is finite and greater.

    :param addresses: Where arrays start.
    :param sizes: How many numbers each has.
    :param max_norm: The norm; infinity to leave them alone.
    :return: The norm that they had; as torch's, infinite if its square is so in float32.
    """
    total = 0.0
    for place in range(addresses.size):
        numbers = vector(addresses[place], sizes[place])
        squares = 0.0
        for i in range(numbers.size):
            squares += np.float64(numbers[i]) * np.float64(numbers[i])
        total += squares
    norm = math.sqrt(total) if total <= FLOAT32_MAX else np.inf
    factor = F(max_norm / (norm + 1e-6))
    if factor < F(1.0) and norm < np.inf:
        for place in range(addresses.size):
            numbers = vector(addresses[place], sizes[place])
            for i in range(numbers.size):
                numbers[i] *= factor
    return norm


@kernel
def adam(addresses: Integers, sizes: Integers, options: AdamOptions) -> None:
    """Take a step of Adam (Kingma and Ba, 2015), in torch's order of operations.

    :param addresses: Where the gradient, parameter, first and second moment and number of steps of
        each parameter start, shape (5, n); all but the gradient change.
    :param sizes: How many numbers each parameter has, shape (n,).
    :param options: Adam's.
    """
    beta1, beta2, eps = F(options.beta1), F(options.beta2), F(options.eps)
    rest1, rest2 = F(1.0 - options.beta1), F(1.0 - options.beta2)
    decay = F(0.0) if options.decoupled else F(options.weight_decay)
    kept = F(1.0 - options.lr * options.weight_decay) if options.decoupled else F(1.0)
    for place in range(sizes.size):
        size, steps = sizes[place], vector(addresses[4, place], 1)
        grads, values = vector(addresses[0, place], size), vector(addresses[1, place], size)
        means, squares = vector(addresses[2, place], size), vector(addresses[3, place], size)
        steps[0] += F(1.0)
        step_size = F(options.lr / (1.0 - options.beta1 ** steps[0]))
        scale = F(math.sqrt(1.0 - options.beta2 ** steps[0]))
        for i in range(size):
            value = kept * values[i]
            grad = grads[i] + decay * value
            means[i] = beta1 * means[i] + rest1 * grad
            squares[i] = beta2 * squares[i] + rest2 * grad * grad
            values[i] = value - step_size * means[i] / (math.sqrt(squares[i]) / scale + eps)
