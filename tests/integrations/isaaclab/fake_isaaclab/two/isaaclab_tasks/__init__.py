"""The tasks of version 2."""

import fake_lab

NAMES = ["Isaac-Velocity-Flat-Anymal-D-v0", "Isaac-Quadcopter-Direct-v0", "Isaac-Ant-v0"]
fake_lab.register(NAMES, "fake_lab:EnvConfig")
