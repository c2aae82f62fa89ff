"""The tasks of version 3, some of which have new names."""

from dataclasses import dataclass

import fake_lab


@dataclass
class EnvConfig(fake_lab.EnvConfig):
    compute_final_obs: bool = False


NAMES = ["Isaac-Velocity-Flat-AnymalD", "IsaacContrib-Lift-Cube-Franka", "Isaac-Ant"]
fake_lab.register(NAMES, "isaaclab_tasks:EnvConfig")
