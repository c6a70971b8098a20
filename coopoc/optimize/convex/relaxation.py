"""Semidefinite relaxation of the QCQP, by a cone solver (Shor) and low-rank factors (the staircase), and certificates.

With the free positions eliminated (newton.py) the cost is 1/2 <C, Z>, Z = X X^T. The relaxation keeps Z positive
semidefinite with the diagonal blocks that the constraints give it, and drops its rank: a bound that no point beats, and
a start from which to refine.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.sparse import csc_matrix

from ...arrays import Floats
from ...errors import InputError, require
from ...short_repr import short_repr
from ...workers import progress_bar
from ..algebra.cholesky import cholesky_of
from ..model.problem import Problem
from ..solution import Solution
from ..solve import solve
from .newton import DENSE, Reduced, Stationary, minimise
from .qcqp import Multipliers, multipliers, quadratic

LARGEST = 60
"""Constrained rows up to which `shor` takes seconds at most; from some 30 rows on `staircase` is the faster one."""
TIGHT = 1e-6
"""Gap of a tight relaxation, as a share of the cost (at least of 1)."""
SOLVER = {
    **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9),
    **dict.fromkeys(("verbose", "presolve_enable", "chordal_decomposition_enable"), False),
    "max_threads": 1,
}
"""Settings of Clarabel."""
START = 2
"""Columns beyond d at a random start: with none to spare the first steps end in local minima."""
HEIGHT = 12
"""Columns beyond d after which the staircase gives up; the bound then is what it has proved by that time."""
FAR = 1e-2
"""Gap, as a share of the cost (at least of 1), from which a share of the multipliers may prove more than all."""
BISECTIONS = 10
"""Of that share."""
ROUNDING = 1e-12
"""Of the mean diagonal, by which a factorisation may be off."""
STALL = 1e-9
"""Share of the cost (at least of 1) that one more column must save to be followed by another."""
ALIKE = 1e-2
"""Sum of squares below which two points are one: what is this near, the curvature at a minimum decides."""
GAP = 1e-6
"""Largest gap of a certified solution, as a share of its cost (at least of 1, the cost of two residuals of one std)."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Lower bound, rounded point and solution of a relaxation.

    Args:
        lower_bound: no point has a smaller cost; corrected for the solver's error, so that it holds to rounding.
        rank_gap: eigenvalue d + 1 over eigenvalue d of Z (second over first where the columns are stacked): 0 if tight.
        x: (n, ambient) the rounded point, m and rotations.
        cost: of it.
        solution: refined from it by Gauss-Newton; None if that was not asked for.
        seconds: in all.
    """

    lower_bound: float
    rank_gap: float
    x: Floats
    cost: float
    solution: Solution | None
    seconds: float

    __repr__ = short_repr

    @property
    def gap(self) -> float:
        """Cost of the best point found less the bound, at least 0."""
        best = self.cost if self.solution is None else min(self.cost, self.solution.cost)
        return max(best - self.lower_bound, 0.0)

    @property
    def tight(self) -> bool:
        """True if the best point found is a global optimum, to TIGHT."""
        return self.gap <= TIGHT * max(self.lower_bound, 1.0)


def shor(problem: Problem, refine: bool = True) -> Relaxation:
    """Shor's semidefinite relaxation by Clarabel, rounded and refined.

    minimise 1/2 <C, Z> over Z >= 0 with Z_BB = I on Stiefel blocks, tr Z_BB = 1 on spheres. For scalar weights Z has
    d + m rows with m ranges, and the same value as with the d m + 1 rows of [1; vec s][1; vec s]^T. Tight (rank d) in
    nearly all stars whose vehicles have fixes, in half of the plane's meshes, less often with anisotropic weights or
    precise ranges beside vague fixes, seldom where vehicles have no fix (benchmarks/tightness.py).

    Args:
        problem: one that `quadratic` takes.
        refine: follow by `solve` from the rounded point.

    Raises:
        InputError: as `quadratic`, or more than LARGEST constrained rows. MissingLibraryError: Clarabel.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> relaxed = shor(problem.add("range", ("a", "b"), 6.0, std=1.0))
    >>> round(relaxed.lower_bound, 6), relaxed.tight
    (0.666667, True)
    """
    began = time.perf_counter()
    form = quadratic(problem)
    if form.bound > LARGEST:
        hint = "Use staircase(problem): the same relaxation by low-rank factors."
        raise InputError("problem", f"{form.bound} constrained rows", f"must have at most {LARGEST}", hint)
    reduced = Reduced(form)
    block, sphere, Z = semidefinite(form.stiefel.shape, form.sphere.shape)(reduced.matrix)
    bound = reduced.lower_bound(Multipliers(form, block, sphere))[0]
    values, vectors = np.linalg.eigh(Z)
    return _rounded(problem, reduced, vectors * np.sqrt(np.maximum(values, 0.0)), bound, began, refine)


@lru_cache(maxsize=64)
def semidefinite(
    stiefel: tuple[int, int], sphere: tuple[int, int]
) -> Callable[[Floats], tuple[Floats, Floats, Floats]]:
    """Solver of max 1/2 tr L over block-diagonal L with C - L >= 0, the dual of min 1/2 <C, Z>, built once per shape.

    Clarabel solves min q'x, A x + s = b, s in a cone; a new C is a new b. It takes C (bound, bound) and returns the
    multipliers of Stiefel blocks (n, k, k) and of spheres (m,), and Z.
    """
    require("clarabel", "a convex relaxation")
    clarabel = importlib.import_module("clarabel")
    (n, k), (m, q) = stiefel, sphere
    size, pairs = n * k + m * q, k * (k + 1) // 2
    (j, i), (high, low) = np.tril_indices(size), np.tril_indices(k)  # upper triangles, column by column
    entry = np.zeros((size, size), dtype=np.int64)
    entry[i, j] = np.arange(len(i))
    first = k * np.arange(n)[:, None]
    row = np.concatenate([entry[first + low, first + high].ravel(), entry.diagonal()[n * k :]])
    column = np.concatenate([np.arange(n * pairs), n * pairs + np.repeat(np.arange(m), q)])
    stretch = np.where(i == j, 1.0, np.sqrt(2.0))
    A = csc_matrix((stretch[row], (row, column)), shape=(len(i), n * pairs + m))
    goal = np.concatenate([np.tile((low == high).astype(float), n), np.ones(m)])
    settings, cone = clarabel.DefaultSettings(), clarabel.PSDTriangleConeT(size)
    for name, value in SOLVER.items():
        setattr(settings, name, value)
    solver = clarabel.DefaultSolver(csc_matrix((len(goal),) * 2), -goal, A, np.zeros(len(i)), [cone], settings)

    def run(C: Floats) -> tuple[Floats, Floats, Floats]:
        scale = max(float(np.trace(C)) / size, 1e-300)
        solver.update(b=stretch * C[i, j] / scale)
        answer = solver.solve()
        values, block, Z = scale * np.array(answer.x), np.zeros((n, k, k)), np.zeros((size, size))
        Z[i, j] = Z[j, i] = np.array(answer.z) / stretch
        block[:, low, high] = block[:, high, low] = values[: n * pairs].reshape(n, pairs)
        return block, values[n * pairs :], Z

    return run


def _rounded(problem: Problem, reduced: Reduced, Y: Floats, bound: float, began: float, refine: bool) -> Relaxation:
    """The relaxation Z = Y Y^T put back on the manifolds by the nearest of rank d, and what refining makes of it.

    The refined point's own bound is taken where it is better; it never exceeds Shor's.
    """
    form, space = reduced.problem, problem.space
    _, values, rows = np.linalg.svd(Y, full_matrices=False)
    d = form.columns
    gap = float(np.square(values[d] / max(values[d - 1], 1e-300))) if len(values) > d else 0.0
    top = np.pad(Y @ rows[:d].T, ((0, 0), (0, d - len(rows[:d]))))
    x, solution = space.join(*form.drop(reduced.settle(form.project(top)))), None
    if refine:
        solution = solve(replace(problem, x0=x), throw=False)
        X = form.lift(space.position(solution.x), space.rotation(solution.x))[: form.bound]
        bound = max(bound, reduced.lower_bound(multipliers(form, X, reduced.times(X)))[0])
    return Relaxation(max(bound, 0.0), gap, x, problem.cost(x), solution, time.perf_counter() - began)


def staircase(problem: Problem, refine: bool = True, seed: int = 0, seconds: float = np.inf) -> Relaxation:
    """The semidefinite relaxation of `shor` with Z = Y Y^T, Y of a few columns (Burer and Monteiro), rounded and
    refined.

    minimise 1/2 <C, Y Y^T> over Y with p columns; if C - L has a negative eigenvalue there, its eigenvector in a new
    column p + 1 leads down, else the relaxation is solved: whatever the start, the bound is that of `shor` (CORA, arXiv
    2302.11614). Poses need not be known even roughly: the start is random unless the problem has an x0. A thousand
    poses take seconds.

    Args:
        problem: one that `quadratic` takes.
        refine: follow by `solve` from the rounded point.
        seed: of the random start.
        seconds: after which to stop, with the best bound by then.

    Raises:
        InputError: as `quadratic`; seconds that are not positive.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> round(staircase(problem.add("range", ("a", "b"), 6.0, std=1.0)).lower_bound, 6)
    0.666667
    """
    if not seconds > 0:
        raise InputError("seconds", seconds, "must be positive", "Leave it out for as long as it takes.")
    began, space = time.perf_counter(), problem.space
    form = quadratic(problem)
    reduced = Reduced(form)
    if problem.x0 is None:
        Y = form.project(np.random.default_rng(seed).standard_normal((form.bound, form.columns + START)))
    else:
        Y = form.lift(space.position(problem.x0), space.rotation(problem.x0))[: form.bound]
    found, bound = _climb(reduced, Y, form.columns + HEIGHT, began + seconds)
    return _rounded(problem, reduced, found.X, bound, began, refine)


def _climb(reduced: Reduced, Y: Floats, most: int, deadline: float) -> tuple[Stationary, float]:
    """A stationary point and the best bound on the way; the two agree, unless `most` columns, rounding or the time
    (time.perf_counter() of the `deadline`) stop it."""
    bound, before = -np.inf, np.inf
    with progress_bar(desc="staircase", unit=" steps", delay=2.0) as bar:
        while True:
            found = minimise(reduced, Y, deadline=deadline, tick=bar.update)
            proved, (smallest,), vector = reduced.lower_bound(found.multipliers)
            bound, size = max(bound, proved), max(found.cost, 1.0)
            if reduced.problem.bound > DENSE and found.cost - proved > FAR * size:
                bound = max(bound, scaled_bound(reduced, found.multipliers))
            late = Y.shape[1] >= most or time.perf_counter() > deadline
            if late or found.cost - bound <= TIGHT * size or before - found.cost <= STALL * size:
                return found, bound
            bar.set_postfix(columns=Y.shape[1] + 1, cost=f"{found.cost:.6g}", bound=f"{max(bound, 0.0):.6g}")
            Y, before = _escape(reduced, found, smallest, vector), found.cost


def scaled_bound(reduced: Reduced, L: Multipliers) -> float:
    """1/2 a tr L with the largest share a in [0, 1) of the multipliers for which C - a L is positive semidefinite.

    Such multipliers are feasible, whatever L. Where C - L is indefinite in a few directions they prove more than a
    shift of all rows by the smallest eigenvalue.
    """
    share, fails, shift = 0.0, 1.0, ROUNDING * reduced.scale
    for _ in range(BISECTIONS):
        middle = 0.5 * (share + fails)
        if cholesky_of(reduced.shifted(middle * L.matrix, -shift)) is None:
            fails = middle
        else:
            share = middle
    return 0.5 * (share * L.trace - shift * L.problem.trace)


def _escape(reduced: Reduced, end: Stationary, smallest: float, v: Floats) -> Floats:
    """A lower point with one more column: along v the cost is cost + 1/2 smallest a^2 + O(a^3)."""
    form = reduced.problem
    wide = np.column_stack([end.X, np.zeros(len(v))])
    along = np.zeros_like(wide)
    along[:, -1] = v
    reach = np.sqrt(form.bound)
    while True:
        Y = form.project(wide + reach * along)
        cost = 0.5 * float(np.sum(Y * reduced.times(Y)))
        if cost <= end.cost + 0.125 * smallest * reach * reach or reach < 1e-6:
            return Y
        reach *= 0.5


@dataclass(frozen=True)
class Certificate:
    """Bounds of a solution's cost against the smallest cost of any point.

    Args:
        certified: no point has a cost smaller by more than a share GAP of max(cost, 1).
        sentence: the verdict in words.
        cost: of the solution.
        lower_bound: no point has a smaller cost.
        smallest_eigenvalue: of C - L.
        unique: no other point costs as little, up to a motion of all: 2 gap / lambda_{d + 1} of C - L bounds the sum of
            squares by which unit vectors and rotations of such a point leave the span of the solution's.
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


def certify(problem: Problem, solution: Solution, seconds: float = 0.0) -> Certificate:
    """Certificate of a solution, at the price of one eigenvalue; a relaxation is solved only if there are `seconds`.

    With the multipliers L that belong to the solution's X in closed form, every point of the QCQP costs at least

        1/2 tr L + 1/2 tr(X X^T) min(0, lambda_min(C - L)),       tr(X X^T) fixed by the constraints,

    and 1/2 tr L is the solution's own cost (Lagrangian duality; CORA, arXiv 2302.11614). Where
    lambda_min is negative the solution may be a local minimum, or the relaxation is not tight there: `shor` or
    `staircase` then give a better bound.

    Args:
        problem: one that `quadratic` takes.
        solution: of it.
        seconds: for a better bound where the first proves nothing: that of `staircase` from the solution.

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
    bound, values, _ = reduced.lower_bound(multipliers(form, X, reduced.times(X)), form.columns + 1)
    if seconds > 0 and solution.cost - bound > GAP * max(solution.cost, 1.0):
        bound = max(bound, staircase(replace(problem, x0=x), refine=False, seconds=seconds).lower_bound)
    gap, smallest = solution.cost - bound, float(values[0])
    certified = gap <= GAP * max(solution.cost, 1.0)
    framed = form.stiefel.size and len(values) > form.columns
    unique = certified and bool(framed and 2.0 * max(gap, 0.0) < ALIKE * values[-1])
    other = "no other point costs as little" if unique else "another, such as a mirror image, may cost as little"
    sentence = (
        f"certified global optimum of {problem!r}, and {other}"
        if certified
        else f"not certified: cost {solution.cost:.6g}, no point of {problem!r} costs less than {max(bound, 0.0):.6g} "
        f"(smallest eigenvalue {smallest:.1e}); a local minimum, or the relaxation is not tight"
    )
    return Certificate(certified, sentence, solution.cost, max(bound, 0.0), smallest, unique)
