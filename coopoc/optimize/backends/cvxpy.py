"""cvxpy: Shor's semidefinite relaxation, rounded and refined; the extras hold its bound."""

from ...arrays import Floats
from ..backend import Backend, Capabilities, SolverResult
from ..convex.qcqp import TERMS
from ..convex.relaxation import shor
from ..model.problem import Problem


def solver(problem: Problem, x: Floats) -> SolverResult:
    """Solve a problem.

    Args:
        problem: that is solved.
        x: start, which a relaxation does not need.
    """
    found = shor(problem)
    extras = {"lower_bound": found.lower_bound, "rank_gap": found.rank_gap, "rounded_cost": found.cost}
    return SolverResult(found.solution.x, found.solution.iterations, extras=extras)


BACKEND = Backend(
    "cvxpy",
    solver,
    "cvxpy",
    Capabilities(kinds=tuple(TERMS), losses=()),
)
