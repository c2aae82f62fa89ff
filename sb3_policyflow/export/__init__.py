"""Export of policies to files that run without this package: ONNX, or torch alone."""

from sb3_policyflow.export.export import export, load_model, load_policy
from sb3_policyflow.export.modules import ActionModule, NormalizeObservation

__all__ = ["ActionModule", "NormalizeObservation", "export", "load_model", "load_policy"]
