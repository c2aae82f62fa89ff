"""Policies that start from demonstrations."""

from sb3_policyflow.imitation.cloning import clone
from sb3_policyflow.imitation.demonstrations import Demonstrations, load_demonstrations

__all__ = ["Demonstrations", "clone", "load_demonstrations"]
