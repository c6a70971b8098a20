"""The optimisation problem and its solvers: points, factors between them, and backends by name."""

from .batch import Batch, solve_batch
from .factor import Factor
from .measurements import MEASUREMENTS, Measurement, measurement
from .problem import Problem
from .solution import Solution, SolveError, Status
from .solve import Backend, backends, solve

__all__ = [
    "MEASUREMENTS", "Backend", "Batch", "Factor", "Measurement", "Problem", "Solution", "SolveError", "Status",
    "backends", "measurement", "solve", "solve_batch",
]  # fmt: skip
