from sb3_policyflow.dppo.dppo import DPPO
from sb3_policyflow.dppo.policies import (
    CnnFlowPolicy,
    DPPOPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
)

__all__ = ["DPPO", "CnnFlowPolicy", "DPPOPolicy", "MlpFlowPolicy", "MultiInputFlowPolicy"]
