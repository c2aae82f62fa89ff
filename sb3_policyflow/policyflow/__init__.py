from sb3_policyflow.policyflow.policies import (
    CnnFlowPolicy,
    FlowPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
    PolicyFlowPolicy,
)
from sb3_policyflow.policyflow.policyflow import PolicyFlow

__all__ = [
    "CnnFlowPolicy",
    "FlowPolicy",
    "MlpFlowPolicy",
    "MultiInputFlowPolicy",
    "PolicyFlow",
    "PolicyFlowPolicy",
]
