"""cvxpy: Shor's semidefinite relaxation, rounded and refined; the extras hold its bound."""

from ...arrays import Floats
from ..backend import Backend, Capabilities, SolverResult
from ..convex.qcqp import TERMS
from ..convex.relaxation import shor
from ..model.problem import Problem


def solver(problem: Problem, x: Floats, refine: bool = True) -> SolverResult:
    """Solve a problem.

    Args:
        problem: that is solved.
        x: start, which a relaxation does not need.
        refine: from the rounded point to a minimum by gauss-newton; without it the answer is the relaxation's own.
    """
    found = shor(problem, refine)
    end = (found.x, 0) if found.solution is None else (found.solution.x, found.solution.iterations)
    extras = {"lower_bound": found.lower_bound, "rank_gap": found.rank_gap, "rounded_cost": found.cost}
    return SolverResult(*end, extras=extras | {"refined": refine})


BACKEND = Backend(
    "cvxpy",
    solver,
    "cvxpy",
    Capabilities(kinds=tuple(TERMS), losses=()),
)
