"""The wrapper of version 2, which has bounds of its own for actions."""

from typing import Any

import fake_lab
from fake_lab import process_sb3_cfg

__all__ = ["Sb3VecEnvWrapper", "process_sb3_cfg"]


class Sb3VecEnvWrapper(fake_lab.Sb3Wrapper):
    def __init__(self, env: Any, fast_variant: bool = True) -> None:
        super().__init__(env, -100.0, 100.0)
