from sb3_policyflow.fpo.fpo import FPO
from sb3_policyflow.fpo.policies import (
    CnnFlowPolicy,
    FPOPolicy,
    MlpFlowPolicy,
    MultiInputFlowPolicy,
)

__all__ = ["FPO", "CnnFlowPolicy", "FPOPolicy", "MlpFlowPolicy", "MultiInputFlowPolicy"]
