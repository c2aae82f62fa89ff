"""Continuous normalizing flows for policies, in plain torch.

Fields, interpolants, solvers and times, and the flow that they make.
"""

from sb3_policyflow.flows.flow import Flow
from sb3_policyflow.flows.interpolants import (
    INTERPOLANTS,
    PATHS,
    ExactStochasticInterpolant,
    Interpolant,
    Path,
    Rectified,
    StochasticInterpolant,
    TrigFlow,
)
from sb3_policyflow.flows.matching import MatchingSamples, draw_matching
from sb3_policyflow.flows.solvers import SOLVERS, Solver, integrate
from sb3_policyflow.flows.times import (
    TIME_SAMPLERS,
    GridTimes,
    GridTimesWithoutEnd,
    StartTimes,
    TimeSampler,
    UniformTimes,
)
from sb3_policyflow.flows.velocity import INITIALIZATIONS, FourierTimeEmbedding, VelocityField

INITIALISATIONS = INITIALIZATIONS
"""Deprecated alias of :data:`INITIALIZATIONS`."""

__all__ = [
    "INITIALISATIONS",
    "INITIALIZATIONS",
    "INTERPOLANTS",
    "PATHS",
    "SOLVERS",
    "TIME_SAMPLERS",
    "ExactStochasticInterpolant",
    "Flow",
    "FourierTimeEmbedding",
    "GridTimes",
    "GridTimesWithoutEnd",
    "Interpolant",
    "MatchingSamples",
    "Path",
    "Rectified",
    "Solver",
    "StartTimes",
    "StochasticInterpolant",
    "TimeSampler",
    "TrigFlow",
    "UniformTimes",
    "VelocityField",
    "draw_matching",
    "integrate",
]
