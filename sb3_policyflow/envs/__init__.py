"""Environments of the paper, registered with Gymnasium when the package is imported."""

from sb3_policyflow.envs.extras import import_extra
from sb3_policyflow.envs.registration import ensure_registered, register
from sb3_policyflow.envs.task_names import PLAYGROUND, PLAYGROUND_TASKS

__all__ = ["PLAYGROUND", "PLAYGROUND_TASKS", "ensure_registered", "import_extra", "register"]
