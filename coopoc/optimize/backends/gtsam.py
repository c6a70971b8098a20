"""gtsam: GTSAM's own Levenberg-Marquardt on its own factors, and on CustomFactors where it has none.

No step is ours: the answer is a second opinion. What GTSAM lacks, such as range, azimuth and inclination in the world
frame with a std each, is a callback from C++ into Python, which takes some twenty times as long as a factor of its own.
"""

from __future__ import annotations

from ...arrays import Floats
from ..backend import Backend, Solver, SolverResult
from ..descent.levenberg_marquardt import MAX_ITERATIONS, TOLERANCE, check_limits
from ..model.problem import Problem
from .gtsam_factors import estimate, forms, graph_of, values, which_turn

STARTS = 3
"""Times that the optimiser begins anew where it ended, with damping as at first, while it ended with more."""
PRECISE = 1e-15
"""Share of the cost by which a step must lower it to be followed by another; GTSAM's own 1e-5 leaves millimetres."""


def prepare(structure: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Solver:
    """Solver of a structure.

    Args:
        structure: a problem whose structure counts.
        max_iterations: of GTSAM's linear solves that lowered the cost.
        tolerance: m or rad, which GTSAM, that stops by the cost, does not know.
    """
    check_limits(max_iterations, tolerance)

    def solver(problem: Problem, x: Floats) -> SolverResult:
        import gtsam

        posed, parts = which_turn(problem), forms(problem)
        graph, used, custom = graph_of(problem, parts), 0, parts.count(None)
        for _ in range(STARTS):
            params = gtsam.LevenbergMarquardtParams()
            params.setMaxIterations(max_iterations - used)
            params.setRelativeErrorTol(PRECISE)
            params.setAbsoluteErrorTol(0.0)
            found = gtsam.LevenbergMarquardtOptimizer(graph, values(problem.space, posed, x), params)
            try:
                x = estimate(problem.space, posed, found.optimize())
            except RuntimeError:  # a singular system: `solve` names the nodes that are free
                break
            used += found.iterations()
            if used >= max_iterations or found.lambda_() <= params.getlambdaInitial():
                break
        return SolverResult(x, used, extras={"custom_factors": custom})

    return solver


BACKEND = Backend(
    "gtsam",
    prepare,
    "a second opinion: GTSAM's own Levenberg-Marquardt, factors and robust noise models",
    "gtsam",
)
