"""certify: whether a solution is the best there is, by the dual certificate of its QCQP."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..model.problem import Problem
from ..solution import Solution
from .newton import Reduced
from .qcqp import multipliers, quadratic
from .relaxation import staircase

TOLERANCE = 1e-6
"""Largest gap of a certified solution, as a share of its cost (at least of 1, the cost of two residuals of one std)."""


@dataclass(frozen=True)
class Certificate:
    """Bounds of a solution's cost against the smallest cost of any point.

    Args:
        certified: no point has a cost smaller by more than the tolerance.
        sentence: the verdict in words.
        cost: of the solution.
        lower_bound: no point has a smaller cost.
        smallest_eigenvalue: of C - L.
    """

    certified: bool
    sentence: str
    cost: float
    lower_bound: float
    smallest_eigenvalue: float

    @property
    def gap(self) -> float:
        """cost - lower_bound, at least 0."""
        return max(self.cost - self.lower_bound, 0.0)

    def __str__(self) -> str:
        return self.sentence


def certify(problem: Problem, solution: Solution, tolerance: float = TOLERANCE, seconds: float = 0.0) -> Certificate:
    """Certificate of a solution, at the price of one eigenvalue; a relaxation is solved only if there are `seconds`.

    With the multipliers L that belong to the solution's X in closed form, every point of the QCQP costs at least

        1/2 tr L + 1/2 tr(X X^T) min(0, lambda_min(C - L)),       tr(X X^T) fixed by the constraints,

    and 1/2 tr L is the solution's own cost (Lagrangian duality; CORA, arXiv 2302.11614). Where
    lambda_min is negative the solution may be a local minimum, or the relaxation is not tight there: `shor` or
    `staircase` then give a better bound.

    Args:
        problem: one that `quadratic` takes.
        solution: of it.
        tolerance: largest gap, as a share of max(cost, 1).
        seconds: for a better bound where the first proves nothing: that of `staircase` from the solution.

    Raises:
        InputError: as `quadratic`.

    >>> from coopoc.optimize import solve
    >>> fixes = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> problem = fixes.add("range", ("a", "b"), 5.0, std=0.5)
    >>> print(certify(problem, solve(problem)))
    certified global optimum of Problem(2 points; 2 position, 1 range)
    """
    form = quadratic(problem)
    x = solution.x
    X = form.lift(problem.space.position(x), problem.space.rotation(x))[: form.bound]
    reduced = Reduced(form)
    bound, smallest, _ = reduced.lower_bound(multipliers(form, X, reduced.times(X)))
    if seconds > 0 and solution.cost - bound > tolerance * max(solution.cost, 1.0):
        bound = max(bound, staircase(replace(problem, x0=x), refine=False, seconds=seconds).lower_bound)
    certified = solution.cost - bound <= tolerance * max(solution.cost, 1.0)
    sentence = (
        f"certified global optimum of {problem!r}"
        if certified
        else (
            f"not certified: cost {solution.cost:.6g}, no point of {problem!r} costs less than {max(bound, 0.0):.6g} "
            f"(smallest eigenvalue {smallest:.1e}); a local minimum, or the relaxation is not tight"
        )
    )
    return Certificate(certified, sentence, solution.cost, max(bound, 0.0), smallest)
