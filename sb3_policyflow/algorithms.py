"""The algorithms of this package, by the names that commands and files have for them."""

from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.dppo import DPPO
from sb3_policyflow.fpo import FPO
from sb3_policyflow.policyflow import PolicyFlow

ALGORITHMS: dict[str, type[FlowOnPolicyAlgorithm]] = {
    "policyflow": PolicyFlow,
    "fpo": FPO,
    "dppo": DPPO,
}
"""For instance what ``--algo`` of rl_zoo3 takes; each has its ``hyperparams/NAME.yml``."""
