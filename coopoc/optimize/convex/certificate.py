"""certify: whether a solution is the best there is, by the dual certificate of its QCQP."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..model.problem import Problem
from ..solution import Solution
from .qcqp import multipliers
from .quadratic import quadratic
from .schur import lower_bound, reduce

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
        surrogate: the replaced factors; all the above then is about the surrogate and its own minimum.
    """

    certified: bool
    sentence: str
    cost: float
    lower_bound: float
    smallest_eigenvalue: float
    surrogate: tuple[str, ...] = ()

    @property
    def gap(self) -> float:
        """cost - lower_bound, at least 0."""
        return max(self.cost - self.lower_bound, 0.0)

    def __str__(self) -> str:
        return self.sentence


def certify(
    problem: Problem,
    solution: Solution,
    tolerance: float = TOLERANCE,
    surrogate: bool = False,
    seconds: float = 0.0,
) -> Certificate:
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
        surrogate: replace what is not quadratic (`surrogate`), solve that from the solution and certify its minimum;
            the sentence names the replaced factors and the distance of the two points.
        seconds: for a better bound where the first proves nothing: that of `staircase` from the solution.

    Raises:
        InputError: as `quadratic`, or as `surrogate`.

    >>> from coopoc.optimize import solve
    >>> fixes = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> problem = fixes.add("range", ("a", "b"), 5.0, std=0.5)
    >>> print(certify(problem, solve(problem)))
    certified global optimum of Problem(2 points; 2 position, 1 range)
    """
    if surrogate:
        return _by_surrogate(problem, solution, tolerance, seconds)
    form = quadratic(problem)
    x = solution.x
    X = form.lift(problem.space.position(x), problem.space.rotation(x))[: form.bound]
    reduced = reduce(form)
    bound, smallest, _ = lower_bound(reduced, multipliers(form, X, reduced.times(X)))
    if seconds > 0 and solution.cost - bound > tolerance * max(solution.cost, 1.0):
        from .staircase import staircase

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


def _by_surrogate(problem: Problem, solution: Solution, tolerance: float, seconds: float) -> Certificate:
    from ..solve import solve
    from .surrogate import surrogate

    other = surrogate(problem)
    found = solve(replace(other.problem, x0=solution.x), throw=False)
    verdict = certify(other.problem, found, tolerance, seconds=seconds)
    space = problem.space
    apart = np.linalg.norm(space.position(found.x) - space.position(solution.x), axis=1).max(initial=0.0)
    note = f"; surrogate: {'; '.join(other.replaced) or 'nothing replaced'}; at most {apart:.3g} m from the solution"
    return replace(verdict, sentence=verdict.sentence + note, surrogate=other.replaced)
