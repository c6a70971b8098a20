"""The optimisation problem and its solvers: nodes, factors between them, and backends by name."""

from . import backends as _package  # noqa: F401  (first: the function `backends` takes its name)
from .backend import Backend, Capabilities, SolverResult, backends
from .batch import Batch, solve_batch
from .descent.local_problem import LocalProblem
from .distributed import Distributed, solve_distributed
from .graphs import loop_closures
from .joint import joint_covariance
from .model import kinds as _kinds  # noqa: F401  (registers the kinds that we know)
from .model.factor import Constraint, Factor
from .model.losses import Loss
from .model.measurements import MEASUREMENTS, Measurement, measurement
from .model.problem import Problem
from .model.space import Space, pose
from .robust.gnc import solve_gnc
from .solution import Solution, SolveError, Status
from .solve import solve

__all__ = [
    "MEASUREMENTS",
    "Backend",
    "Batch",
    "Capabilities",
    "Constraint",
    "Distributed",
    "Factor",
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
]
