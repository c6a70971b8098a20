"""The optimisation problem and its solvers: nodes, factors between them, and backends by name."""

from . import backends as _package  # noqa: F401  (first: the function `backends` takes its name)
from .assess.assess import joint_covariance
from .backend import Backend, Capabilities, SolverResult, backends
from .graph_problems import loop_closures
from .incremental import Incremental, incremental
from .model.factor import Constraint, Factor, Loss
from .model.measurements import MEASUREMENTS, Measurement, measurement
from .model.problem import Problem
from .model.space import Space, pose
from .robust.gnc import solve_gnc
from .solution import Solution, SolveError, Status
from .solve import solve

__all__ = [
    "MEASUREMENTS",
    "Backend",
    "Capabilities",
    "Constraint",
    "Factor",
    "Incremental",
    "Loss",
    "Measurement",
    "Problem",
    "Solution",
    "SolveError",
    "SolverResult",
    "Space",
    "Status",
    "backends",
    "incremental",
    "joint_covariance",
    "loop_closures",
    "measurement",
    "pose",
    "solve",
    "solve_gnc",
]
