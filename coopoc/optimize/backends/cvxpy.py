"""cvxpy: Shor's semidefinite relaxation, rounded and refined; the extras hold its bound."""

from ...arrays import Floats
from ..backend import Backend, SolverResult
from ..convex.qcqp import QUADRATIC
from ..convex.relaxation import shor
from ..model.problem import Problem


def solver(problem: Problem, x: Floats) -> SolverResult:
    """Solve a problem.

    Args:
        problem: that is solved.
        x: start, which a relaxation does not need.
    """
    relaxed = shor(problem)
    extras = {"lower_bound": relaxed.lower_bound, "rank_gap": relaxed.rank_gap, "rounded_cost": relaxed.cost}
    return SolverResult(relaxed.solution.x, relaxed.solution.iterations, extras=extras)


BACKEND = Backend("cvxpy", solver, "cvxpy", QUADRATIC)
