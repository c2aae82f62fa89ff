from sb3_policyflow.policyflow.policies import (
    CnnFlowPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
    PolicyFlowPolicy,
)
from sb3_policyflow.policyflow.policies import FlowPolicy as FlowPolicy  # its former name
from sb3_policyflow.policyflow.policyflow import PolicyFlow

__all__ = [
    "CnnFlowPolicy",
    "MlpFlowPolicy",
    "MultiInputFlowPolicy",
    "PolicyFlow",
    "PolicyFlowPolicy",
]
