"""The optimisation problem and its solvers: points, factors between them, and backends by name."""

import sys
from types import ModuleType
from typing import Any

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


class _Verb(ModuleType):
    """This room is also its verb: `coopoc.solve(problem)` is `coopoc.solve.solve(problem)`."""

    def __call__(self, problem: Problem, *args: Any, **options: Any) -> Solution:
        return solve(problem, *args, **options)


sys.modules[__name__].__class__ = _Verb
