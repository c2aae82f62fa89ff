"""SBX's PPO (Stable-Baselines3 on JAX)."""

from collections.abc import Callable

from flax import linen
from sbx import PPO

from sb3_policyflow.benchmark.speed.rivals.adapters.sb3 import make_with
from sb3_policyflow.benchmark.speed.rivals.settings import Setting


def make(setting: Setting) -> Callable[[], None]:
    """SBX's PPO; it takes SB3's arguments."""
    return make_with(PPO, setting, {"activation_fn": linen.tanh})
