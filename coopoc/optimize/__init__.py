"""The optimisation problem and its solvers: nodes, factors between them, and backends by name."""

from . import backends as _package  # noqa: F401  (first: the function `backends` takes its name)
from . import kinds as _kinds  # noqa: F401  (registers the kinds that we know)
from .backend import Backend, Capabilities, SolverResult, backends
from .batch import Batch, solve_batch
from .constraint import Constraint
from .distributed import Distributed, solve_distributed
from .factor import Factor
from .gnc import GNCBatch, solve_gnc, solve_gnc_batch
from .graphs import loop_closures
from .joint import joint_covariance
from .local_problem import LocalProblem
from .losses import Loss
from .measurements import MEASUREMENTS, Measurement, measurement
from .problem import Problem
from .solution import Solution, SolveError, Status
from .solve import solve
from .space import Space, pose

__all__ = [
    "MEASUREMENTS",
    "Backend",
    "Batch",
    "Capabilities",
    "Constraint",
    "Distributed",
    "Factor",
    "GNCBatch",
    "LocalProblem",
    "Loss",
    "Measurement",
    "Problem",
    "Solution",
    "SolveError",
    "SolverResult",
    "Space",
    "Status",
    "backends",
    "joint_covariance",
    "loop_closures",
    "measurement",
    "pose",
    "solve",
    "solve_batch",
    "solve_distributed",
    "solve_gnc",
    "solve_gnc_batch",
]
