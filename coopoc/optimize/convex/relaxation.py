"""Shor's semidefinite relaxation of the QCQP, by a cone solver, and certificates of solutions.

With the free positions eliminated (reduced.py) the cost is 1/2 <C, Z>, Z = X X^T. The relaxation keeps Z positive
semidefinite with the diagonal blocks that the constraints give it, and drops its rank: a bound that no point beats, and
a start from which to refine.
"""

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ...arrays import Floats
from ...errors import InputError, said
from ...text import short_repr
from ..model.problem import Problem
from ..solution import Solution
from ..solve import solve
from .qcqp import Multipliers, multipliers, quadratic
from .reduced import Reduced

MAX_SHOR_ROWS = 60
"""Constrained rows up to which `shor` takes seconds at most."""
TIGHT = 1e-6
"""Gap of a tight relaxation, as a share of the cost (at least of 1)."""
SOLVER = {**dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9), "max_threads": 1}
"""Settings of Clarabel."""
SAME_POINT = 1e-2
"""Sum of squares below which two points are one: what is this near, the curvature at a minimum decides."""
CERTIFIED_GAP = 1e-6
"""Largest gap of a certified solution, as a share of its cost (at least of 1, the cost of two residuals of one std)."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Lower bound, rounded point and solution of a relaxation.

    Args:
        lower_bound: no point has a smaller cost; corrected for the solver's error, so that it holds to rounding.
        rank_gap: eigenvalue d + 1 over eigenvalue d of Z (second over first where the columns are stacked): 0 if tight.
        x: (n, ambient) the rounded point, m and rotations.
        cost: of it.
        solution: refined from it by Gauss-Newton.
        seconds: in all.
    """

    lower_bound: float
    rank_gap: float
    x: Floats
    cost: float
    solution: Solution
    seconds: float

    __repr__ = short_repr

    @property
    def gap(self) -> float:
        """Cost of the best point found less the bound, at least 0."""
        return max(min(self.cost, self.solution.cost) - self.lower_bound, 0.0)

    @property
    def tight(self) -> bool:
        """True if the best point found is a global optimum, to TIGHT."""
        return self.gap <= TIGHT * max(self.lower_bound, 1.0)


def shor(problem: Problem) -> Relaxation:
    """Shor's semidefinite relaxation by CVXPY and Clarabel, rounded and refined.

    minimise 1/2 <C, Z> over Z >= 0 with Z_BB = I on Stiefel blocks, tr Z_BB = 1 on spheres. For scalar weights Z has
    d + m rows with m ranges, and the same value as with the d m + 1 rows of [1; vec s][1; vec s]^T. Tight (rank d) in
    nearly all stars whose vehicles have fixes, in half of the plane's meshes, less often with anisotropic weights or
    precise ranges beside vague fixes, seldom where vehicles have no fix (benchmarks/tightness.py).

    Args:
        problem: one that `quadratic` takes.

    Raises:
        InputError: as `quadratic`, or more than MAX_SHOR_ROWS constrained rows.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> relaxed = shor(problem.add("range", ("a", "b"), 6.0, std=1.0))
    >>> round(relaxed.lower_bound, 6), relaxed.tight
    (0.666667, True)
    """
    began = time.perf_counter()
    form = quadratic(problem)
    if form.bound > MAX_SHOR_ROWS:
        hint = "Solve it, and ask certify(problem, solution), which takes any number."
        raise InputError("problem", f"{form.bound} constrained rows", f"must have at most {MAX_SHOR_ROWS}", hint)
    reduced = Reduced(form)
    block, sphere, Z = semidefinite(form.stiefel.shape, form.sphere.shape)(reduced.matrix)
    bound = reduced.lower_bound(Multipliers(form, block, sphere))[0]
    values, vectors = np.linalg.eigh(Z)
    Y, d, space = vectors * np.sqrt(np.maximum(values, 0.0)), form.columns, problem.space
    _, values, rows = np.linalg.svd(Y, full_matrices=False)
    gap = float(np.square(values[d] / max(values[d - 1], 1e-300))) if len(values) > d else 0.0
    top = np.pad(Y @ rows[:d].T, ((0, 0), (0, d - len(rows[:d]))))
    x = space.join(*form.drop(reduced.settle(form.project(top))))
    solution = solve(replace(problem, x0=x), throw=False)
    X = form.lift(space.position(solution.x), space.rotation(solution.x))[: form.bound]
    # the refined point's own bound never exceeds Shor's but by what the solver lacks
    bound = max(bound, reduced.lower_bound(multipliers(form, X, reduced.times(X)))[0])
    return Relaxation(max(bound, 0.0), gap, x, problem.cost(x), solution, time.perf_counter() - began)


@lru_cache(maxsize=64)
def semidefinite(
    stiefel: tuple[int, int], sphere: tuple[int, int]
) -> Callable[[Floats], tuple[Floats, Floats, Floats]]:
    """Solver of min 1/2 <C, Z>, whose dual is max 1/2 tr L over block-diagonal L with C - L >= 0, built once per shape.

    It takes C (bound, bound) and returns the multipliers of Stiefel blocks (n, k, k) and of spheres (m,), and Z.
    """
    cvxpy = importlib.import_module("cvxpy")
    (n, k), (m, q) = stiefel, sphere
    size = n * k + m * q
    Z, C = cvxpy.Variable((size, size), PSD=True), cvxpy.Parameter((size, size), symmetric=True)
    spans = [slice(k * i, k * i + k) for i in range(n)], [slice(n * k + q * j, n * k + q * j + q) for j in range(m)]
    turns = [Z[at, at] == np.eye(k) for at in spans[0]]
    units = [cvxpy.trace(Z[at, at]) == 1 for at in spans[1]]
    programme = cvxpy.Problem(cvxpy.Minimize(cvxpy.trace(C @ Z)), [*turns, *units])

    def run(matrix: Floats) -> tuple[Floats, Floats, Floats]:
        scale = max(float(np.trace(matrix)) / size, 1e-300)
        C.value = (matrix + matrix.T) / (2.0 * scale)
        try:
            programme.solve(solver=cvxpy.CLARABEL, **SOLVER)
        except cvxpy.SolverError as error:
            hint = "Solve it, and ask certify(problem, solution)."
            raise InputError("problem", said(error), "must be one that Clarabel solves", hint) from None
        block = -scale * np.array([each.dual_value for each in turns]).reshape(n, k, k)
        return (block + block.swapaxes(1, 2)) / 2, -scale * np.array([each.dual_value for each in units]), Z.value

    return run


@dataclass(frozen=True)
class Certificate:
    """Bounds of a solution's cost against the smallest cost of any point.

    Args:
        certified: no point has a cost smaller by more than a share CERTIFIED_GAP of max(cost, 1).
        sentence: the verdict in words.
        cost: of the solution.
        lower_bound: no point has a smaller cost.
        smallest_eigenvalue: of C - L.
        unique: no other point costs as little: no node can move freely, and 2 gap / lambda_{d + 1} of C - L bounds the
            sum of squares by which unit vectors and rotations of such a point leave the span of the solution's.
    """

    certified: bool
    sentence: str
    cost: float
    lower_bound: float
    smallest_eigenvalue: float
    unique: bool = False

    @property
    def gap(self) -> float:
        """cost - lower_bound, at least 0."""
        return max(self.cost - self.lower_bound, 0.0)

    def __str__(self) -> str:
        return self.sentence


def certify(problem: Problem, solution: Solution) -> Certificate:
    """Certificate of a solution, at the price of one eigenvalue.

    With the multipliers L that belong to the solution's X in closed form, every point of the QCQP costs at least

        1/2 tr L + 1/2 tr(X X^T) min(0, lambda_min(C - L)),       tr(X X^T) fixed by the constraints,

    and 1/2 tr L is the solution's own cost (Lagrangian duality; CORA, arXiv 2302.11614). Where
    lambda_min is negative the solution may be a local minimum, or the relaxation is not tight there: `shor`
    then gives a better bound.

    Args:
        problem: one that `quadratic` takes.
        solution: of it.

    Raises:
        InputError: as `quadratic`.

    >>> from coopoc.optimize import solve
    >>> fixes = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> problem = fixes.add("range", ("a", "b"), 5.0, std=0.5)
    >>> print(certify(problem, solve(problem)))
    certified global optimum of Problem(2 points; 2 position, 1 range), and no other point costs as little
    """
    form = quadratic(problem)
    x = solution.x
    X = form.lift(problem.space.position(x), problem.space.rotation(x))[: form.bound]
    reduced = Reduced(form)
    bound, values = reduced.lower_bound(multipliers(form, X, reduced.times(X)), form.columns + 1)
    gap, smallest = solution.cost - bound, float(values[0])
    certified = gap <= CERTIFIED_GAP * max(solution.cost, 1.0)
    framed = form.stiefel.size and len(values) > form.columns
    alone = certified and bool(framed and 2.0 * max(gap, 0.0) < SAME_POINT * values[-1])
    unique = alone and not solution.unobservable
    image = "a motion of all, costs" if alone else "a mirror image, may cost"
    other = "no other point costs as little" if unique else f"another, such as {image} as little"
    sentence = (
        f"certified global optimum of {problem!r}, and {other}"
        if certified
        else f"not certified: cost {solution.cost:.6g}, no point of {problem!r} costs less than {max(bound, 0.0):.6g} "
        f"(smallest eigenvalue {smallest:.1e}); a local minimum, or the relaxation is not tight"
    )
    return Certificate(certified, sentence, solution.cost, max(bound, 0.0), smallest, unique)
