"""Gradients clipped by a kernel."""

from collections.abc import Sequence

import numpy as np
import torch as th

from sb3_policyflow.kernels.compiler import load_kernels
from sb3_policyflow.kernels.inspection import addresses, are_usable, why_torch_must_work


def clip_gradients_in_place(grads: Sequence[th.Tensor], max_norm: float) -> float | None:
    """Scale gradients to a Euclidean norm of all together, if theirs is finite and greater.

    :param grads: The gradients.
    :param max_norm: The norm; infinity to leave them alone.
    :return: The norm that they had, or None, and nothing done, where kernels cannot work.
    """
    kernels = load_kernels()
    if isinstance(kernels, str) or why_torch_must_work() or not are_usable(grads):
        return None
    sizes = np.array([grad.numel() for grad in grads])
    return float(kernels.clip(addresses(grads), sizes, max_norm))
