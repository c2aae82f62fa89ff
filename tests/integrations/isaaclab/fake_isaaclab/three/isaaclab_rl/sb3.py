"""The wrapper of version 3, which is told the bounds of actions."""

from typing import Any

import fake_lab
from fake_lab import process_sb3_cfg

__all__ = ["Sb3VecEnvWrapper", "process_sb3_cfg"]


class Sb3VecEnvWrapper(fake_lab.Sb3Wrapper):
    def __init__(
        self, env: Any, fast_variant: bool = True, action_bounds: tuple[float, float] = (-1.0, 1.0)
    ) -> None:
        super().__init__(env, *action_bounds)
