"""cvxpy: Shor's semidefinite relaxation, rounded and refined; the extras hold its bound."""

from functools import partial

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
    return partial(_relaxed, refine)


def _relaxed(refine: bool, problem: Problem, x: Floats) -> SolverResult:
    """The relaxation's point; x is not looked at."""
    relaxation = shor(problem, refine)
    end = (relaxation.x, 0) if relaxation.solution is None else (relaxation.solution.x, relaxation.solution.iterations)
    extras = {"lower_bound": relaxation.lower_bound, "rank_gap": relaxation.rank_gap, "rounded_cost": relaxation.cost}
    return SolverResult(*end, extras=extras | {"refined": refine})


BACKEND = Backend(
    "cvxpy",
    prepare,
    "convex relaxation: Shor's SDP with a lower bound",
    "cvxpy",
    Capabilities(kinds=tuple(TERMS), losses=()),
)
