"""Convex relaxations of the QCQP: a bound that no point beats, and a start from which to refine.

With the free positions eliminated (schur.py) the cost is 1/2 <C, Z>, Z = X X^T. `shor` keeps Z positive semidefinite
with the diagonal blocks that the constraints give it, and drops its rank; `ball` keeps X, H = I, and fills the spheres.
A programme depends on the number of blocks only, so it is built once for all problems of a shape (cones.py).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..problem import Problem
from ..solution import Solution
from ..solve import solve
from .certificate import lower_bound
from .cones import second_order, semidefinite
from .manifold import minimise
from .qcqp import Multipliers, Quadratic
from .quadratic import quadratic
from .schur import Dense, Reduced

LARGEST = 60
"""Constrained rows up to which `shor` takes seconds at most; from some 30 rows on `staircase` is the faster one."""
TIGHT = 1e-6
"""Gap of a tight relaxation, as a share of the cost (at least of 1)."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """What a relaxation says of a problem.

    Args:
        lower_bound: no point has a smaller cost; corrected for the solver's error, so that it holds to rounding.
        rank_gap: eigenvalue d + 1 over eigenvalue d of Z (second over first where the columns are stacked): 0 if tight.
        x: (n, width) the rounded point, m and rotations. cost: of it.
        solution: refined from it by Gauss-Newton; None if that was not asked for. seconds: in all.
    """

    lower_bound: float
    rank_gap: float
    x: Floats
    cost: float
    solution: Solution | None
    seconds: float

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
    """Shor's semidefinite relaxation, rounded and refined.

    minimise 1/2 <C, Z> over Z >= 0 with Z_BB = I on Stiefel blocks, tr Z_BB = 1 on spheres; solved in its dual form,
    one variable per constraint. For scalar weights Z has d + m rows with m ranges, and the same value as with the
    d m + 1 rows of [1; vec s][1; vec s]^T. Tight (rank d) in nearly all stars whose vehicles have fixes, in half of
    the plane's meshes, less often with anisotropic weights or precise ranges beside vague fixes, seldom where vehicles
    have no fix (benchmarks/tightness.py, methods.md section 6.1).

    Args:
        problem: one that `quadratic` takes. refine: follow by `solve` from the rounded point.

    Raises:
        InputError: as `quadratic`, or more than LARGEST constrained rows. MissingLibraryError: Clarabel.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> relaxed = shor(problem.add("range", ("a", "b"), 6.0, std=1.0))
    >>> round(relaxed.lower_bound, 6), relaxed.tight
    (0.666667, True)
    """
    began = time.perf_counter()
    form = small(quadratic(problem))
    reduced = Dense(form)
    block, sphere, Z = semidefinite(form.stiefel.shape, form.sphere.shape)(reduced.matrix)
    bound, *_ = lower_bound(reduced, Multipliers(form, block, sphere))
    X, gap = first_vectors(Z, form.columns)
    return rounded(problem, form, reduced, X, bound, gap, began, refine)


def first_vectors(Z: Floats, d: int) -> tuple[Floats, float]:
    """X (bound, d), the nearest of rank d to Z = X X^T, and eigenvalue d + 1 over eigenvalue d."""
    values, vectors = np.linalg.eigh(Z)
    gap = float(max(values[-d - 1], 0.0) / max(values[-d], 1e-300)) if len(values) > d else 0.0
    top = vectors[:, -d:] * np.sqrt(np.maximum(values[-d:], 0.0))
    return np.pad(top, ((0, 0), (0, d - top.shape[1]))), gap


def rounded(
    problem: Problem, form: Quadratic, reduced: Reduced, X: Floats, bound: float, gap: float, began: float,
    refine: bool, sharpen: bool = True,
) -> Relaxation:  # fmt: skip
    """The relaxation whose X (bound, d) is put back on the manifolds, with its cost and what refining makes of it.

    Args:
        sharpen: take the refined point's own bound where it is better (it never exceeds Shor's).
    """
    x = problem.space.join(*form.drop(reduced.settle(form.project(X))))
    solution = None
    if refine:
        near, proved = polished(problem, form, reduced, x)
        solution = solve(replace(problem, x0=near), throw=False)
        bound = max(bound, proved) if sharpen else bound
    return Relaxation(max(bound, 0.0), gap, x, problem.cost(x), solution, time.perf_counter() - began)


def polished(problem: Problem, form: Quadratic, reduced: Reduced, x: Floats) -> tuple[Floats, float]:
    """(n, width) the stationary point near x, by Newton's steps, and the bound of its own multipliers.

    Gauss-Newton's steps creep in range-only problems, and a solver's bound is short of a tight one by its tolerance.
    """
    space = problem.space
    found = minimise(form, reduced, form.lift(space.position(x), space.rotation(x))[: form.bound])
    return space.join(*form.drop(reduced.settle(found.X))), lower_bound(reduced, found.multipliers)[0]


def ball(problem: Problem, refine: bool = True) -> Relaxation:
    """The relaxation |s| <= 1 of the unit vectors, a second-order cone programme: weaker than `shor`, and convex in x.

    minimise 1/2 <C, [I; s] [I; s]^T> over |s_e| <= 1. Where a vector does not reach its sphere the range is ignored,
    and points are drawn inwards (methods.md sections 6.2 and 6.4). rank_gap is 1 minus the shortest |s_e|.

    Args:
        problem: points only, with at least one fix or displacement. refine: follow by `solve` from the rounded point.

    Raises:
        InputError: as `quadratic`; poses; nothing measured in the world's frame (all vectors would shrink to nothing).
        MissingLibraryError: Clarabel.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> round(ball(problem.add("range", ("a", "b"), 2.0, std=1.0)).lower_bound, 6)
    0.666667
    """
    began = time.perf_counter()
    form = framed(small(quadratic(problem)))
    reduced = Dense(form)
    C, k = reduced.matrix, form.stiefel.size
    s: Floats = np.empty((0, form.columns))
    if form.sphere.size:
        s = second_order(form.columns, form.sphere.shape)(C[k:, k:], C[k:, :k])
    X, bound, gap = in_balls(form, reduced, s)
    return rounded(problem, form, reduced, X, bound, gap, began, refine, sharpen=False)


def in_balls(form: Quadratic, reduced: Dense, s: Floats) -> tuple[Floats, float, float]:
    """[I; s], a bound on what any s in the balls costs, and 1 minus the shortest |s_e|.

    The bound is the Lagrangian's minimum, 1/2 tr(C_HH - C_Hs (C_ss + M)^-1 C_sH) - 1/2 tr M, for any M >= 0 of one
    number per ball; at the optimum that is -<(C [I; s])_e, s_e>.
    """
    k, C = form.stiefel.size, reduced.matrix
    X = np.concatenate([np.eye(form.columns), s])
    pull = np.maximum(-np.einsum("mqp,mqp->m", reduced.times(X)[form.sphere], X[form.sphere]), 0.0)
    pulled = C[k:, k:] + np.diag(np.repeat(pull, form.sphere.shape[1]))
    best = np.linalg.lstsq(pulled, C[k:, :k], rcond=None)[0]
    bound = 0.5 * float(np.trace(C[:k, :k]) - np.sum(C[k:, :k] * best) - pull.sum())
    length = np.sqrt(np.square(X[form.sphere]).sum(axis=(1, 2))).min(initial=1.0)
    return X, bound, float(max(1.0 - length, 0.0))


def small(form: Quadratic) -> Quadratic:
    """The form, unless it has more than LARGEST constrained rows: then InputError."""
    if form.bound > LARGEST:
        mend = "Use staircase(problem): the same relaxation by low-rank factors."
        raise InputError("problem", f"{form.bound} constrained rows", f"must have at most {LARGEST}", mend)
    return form


def framed(form: Quadratic) -> Quadratic:
    """The form, unless `ball` would shrink it to nothing: then InputError."""
    if len(form.poses) or not form.framed:
        what = f"{len(form.poses)} poses" if len(form.poses) else "no fix and no displacement"
        raise InputError("problem", what, "must hold points only, in the world's frame", "Use shor or staircase.")
    return form
