"""gauss-newton: the reference. Levenberg-Marquardt with sparse Cholesky factors."""

import numpy as np

from ...arrays import Floats
from ..algebra.sparse import sparse
from ..backend import MAX_ITERATIONS, SOLVER_STEP_TOLERANCE, Backend, SolverResult
from ..descent.levenberg_marquardt import arrive
from ..model.problem import Problem


def solver(
    problem: Problem, x: Floats, max_iterations: int = MAX_ITERATIONS, tolerance: float = SOLVER_STEP_TOLERANCE
) -> SolverResult:
    """Solve a problem from x (n, ambient).

    Args:
        problem: that is solved.
        x: start.
        max_iterations: of Gauss-Newton steps.
        tolerance: m, largest move of a point in the last step.
    """
    end = arrive(sparse(problem), x, min(1, max_iterations) if problem.linear else max_iterations, tolerance)
    if problem.linear and np.isnan(end.record).any():  # what is free needs damping
        end = arrive(sparse(problem), x, max_iterations, tolerance)
    return SolverResult(end.x, end.iterations, extras={"record": end.record})


BACKEND = Backend(
    "gauss-newton",
    solver,
    library="casadi",  # writes the derivatives of all measurements
)
