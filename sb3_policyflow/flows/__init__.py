"""Continuous normalizing flows for policies, in plain torch: fields, paths, solvers and times."""

from sb3_policyflow.flows.interpolants import (
    PATHS,
    ExactStochasticInterpolant,
    Path,
    Rectified,
    StochasticInterpolant,
    TrigFlow,
)
from sb3_policyflow.flows.solvers import SOLVERS, Solver, integrate
from sb3_policyflow.flows.times import (
    TIME_SAMPLERS,
    GridTimes,
    StartTimes,
    TimeSampler,
    UniformTimes,
)
from sb3_policyflow.flows.velocity import INITIALIZATIONS, FourierTimeEmbedding, VelocityField

__all__ = [
    "INITIALIZATIONS",
    "PATHS",
    "SOLVERS",
    "TIME_SAMPLERS",
    "ExactStochasticInterpolant",
    "FourierTimeEmbedding",
    "GridTimes",
    "Path",
    "Rectified",
    "Solver",
    "StartTimes",
    "StochasticInterpolant",
    "TimeSampler",
    "TrigFlow",
    "UniformTimes",
    "VelocityField",
    "integrate",
]
