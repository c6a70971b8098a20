"""The optimisation problem and its solvers: nodes, factors between them, and backends by name."""

from . import kinds as _kinds  # noqa: F401  (registers the kinds that we know)
from .batch import Batch, solve_batch
from .constraint import Constraint
from .factor import Factor
from .gnc import Graduated, graduate, graduate_batch
from .losses import Loss
from .measurements import MEASUREMENTS, Measurement, measurement
from .problem import Problem
from .solution import Solution, SolveError, Status
from .solve import Backend, backends, solve
from .space import Space, pose

__all__ = [
    "MEASUREMENTS", "Backend", "Batch", "Constraint", "Factor", "Graduated", "Loss", "Measurement", "Problem",
    "Solution", "SolveError", "Space", "Status", "backends", "graduate", "graduate_batch", "measurement", "pose",
    "solve", "solve_batch",
]  # fmt: skip
