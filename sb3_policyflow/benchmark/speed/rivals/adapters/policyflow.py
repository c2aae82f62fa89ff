"""PolicyFlow."""

from collections.abc import Callable

from torch import nn

from sb3_policyflow import PolicyFlow
from sb3_policyflow.benchmark.speed.rivals.adapters.sb3 import make_with
from sb3_policyflow.benchmark.speed.rivals.settings import Setting


def make(setting: Setting) -> Callable[[], None]:
    """PolicyFlow with its defaults: 4 midpoint steps, and embeddings of 64."""
    return make_with(PolicyFlow, setting, {"activation_fn": nn.Tanh, "embedding_dim": 64})
