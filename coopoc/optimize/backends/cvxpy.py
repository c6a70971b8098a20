"""cvxpy: Shor's semidefinite relaxation, rounded and refined; the extras hold its bound."""

from ...arrays import Floats
from ..backend import Backend, Capabilities, Solver, SolverResult
from ..convex.qcqp import TERMS
from ..convex.relaxation import shor
from ..model.problem import Problem


def prepare(structure: Problem, refine: bool = True) -> Solver:
    """Solver of a structure.

    Args:
        structure: a problem whose structure counts.
        refine: from the rounded point to a minimum by gauss-newton; without it the answer is the relaxation's own.
    """

    def solver(problem: Problem, x: Floats) -> SolverResult:  # a relaxation needs no start
        found = shor(problem, refine)
        end = (found.x, 0) if found.solution is None else (found.solution.x, found.solution.iterations)
        extras = {"lower_bound": found.lower_bound, "rank_gap": found.rank_gap, "rounded_cost": found.cost}
        return SolverResult(*end, extras=extras | {"refined": refine})

    return solver


BACKEND = Backend(
    "cvxpy",
    prepare,
    "convex relaxation: Shor's SDP with a lower bound",
    "cvxpy",
    Capabilities(kinds=tuple(TERMS), losses=()),
)
