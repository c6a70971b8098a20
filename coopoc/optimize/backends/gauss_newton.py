"""gauss-newton: the reference. Levenberg-Marquardt with sparse Cholesky factors."""

import numpy as np

from ...arrays import Floats
from ..algebra.sparse import Sparse, sparse
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
    system = sparse(problem)
    if problem.linear and max_iterations and (least := _least(system, x, tolerance)) is not None:
        return SolverResult(least, 1)
    end = arrive(system, x, max_iterations, tolerance)
    return SolverResult(end.x, end.iterations, extras={"record": end.record})


def _least(system: Sparse, x: Floats, tolerance: float) -> Floats | None:
    """The minimum of a quadratic cost from any x by one factorisation: further steps mend what the first, from far
    away, has rounded, while they shrink; None where something is free, which needs damping."""
    before, far = np.inf, np.inf
    while far > tolerance:
        _, gradient, values = system.quadratic(x, "gauss-newton")
        if before == far and not system.cholesky.factor(values):
            return None
        step = system.cholesky.solve(gradient)
        before, far = far, float(abs(step).max())
        if not far < before / 2:
            break
        x = system.retract(x, -step)
    return x


BACKEND = Backend(
    "gauss-newton",
    solver,
    library="casadi",  # writes the derivatives of all measurements
)
