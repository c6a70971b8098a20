"""Convex relaxations of the QCQP: a bound that no point beats, and a start from which to refine.

With the free positions eliminated (schur.py) the cost is 1/2 <C, Z>, Z = X X^T. `shor` keeps Z positive semidefinite
with the diagonal blocks that the constraints give it, and drops its rank. A programme depends on the number of blocks
only, so it is built once for all problems of a shape (cones.py).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ...short_repr import short_repr
from ..model.problem import Problem
from ..solution import Solution
from ..solve import solve
from .cones import semidefinite
from .manifold import minimise
from .qcqp import Multipliers, Quadratic
from .quadratic import quadratic
from .schur import Dense, Reduced, lower_bound

LARGEST = 60
"""Constrained rows up to which `shor` takes seconds at most; from some 30 rows on `staircase` is the faster one."""
TIGHT = 1e-6
"""Gap of a tight relaxation, as a share of the cost (at least of 1)."""


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
    """Shor's semidefinite relaxation, rounded and refined.

    minimise 1/2 <C, Z> over Z >= 0 with Z_BB = I on Stiefel blocks, tr Z_BB = 1 on spheres; solved in its dual form,
    one variable per constraint. For scalar weights Z has d + m rows with m ranges, and the same value as with the
    d m + 1 rows of [1; vec s][1; vec s]^T. Tight (rank d) in nearly all stars whose vehicles have fixes, in half of
    the plane's meshes, less often with anisotropic weights or precise ranges beside vague fixes, seldom where vehicles
    have no fix (benchmarks/tightness.py).

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
    form = small(quadratic(problem))
    reduced = Dense(form)
    block, sphere, Z = semidefinite(form.stiefel.shape, form.sphere.shape)(reduced.matrix)
    bound, *_ = lower_bound(reduced, Multipliers(form, block, sphere))
    return rounded(problem, form, reduced, *first_vectors(Z, form.columns), bound, began, refine)


def first_vectors(Z: Floats, d: int) -> tuple[Floats, float]:
    """X (bound, d), the nearest of rank d to Z = X X^T, and eigenvalue d + 1 over eigenvalue d."""
    values, vectors = np.linalg.eigh(Z)
    gap = float(max(values[-d - 1], 0.0) / max(values[-d], 1e-300)) if len(values) > d else 0.0
    top = vectors[:, -d:] * np.sqrt(np.maximum(values[-d:], 0.0))
    return np.pad(top, ((0, 0), (0, d - top.shape[1]))), gap


def rounded(
    problem: Problem,
    form: Quadratic,
    reduced: Reduced,
    X: Floats,
    gap: float,
    bound: float,
    began: float,
    refine: bool,
) -> Relaxation:
    """The relaxation whose X (bound, d) is put back on the manifolds, with its cost and what refining makes of it.

    The refined point's own bound is taken where it is better; it never exceeds Shor's.
    """
    x = problem.space.join(*form.drop(reduced.settle(form.project(X))))
    solution = None
    if refine:
        near, proved = polished(problem, form, reduced, x)
        solution = solve(replace(problem, x0=near), throw=False)
        bound = max(bound, proved)
    return Relaxation(max(bound, 0.0), gap, x, problem.cost(x), solution, time.perf_counter() - began)


def polished(problem: Problem, form: Quadratic, reduced: Reduced, x: Floats) -> tuple[Floats, float]:
    """(n, ambient) the stationary point near x, by Newton's steps, and the bound of its own multipliers.

    Gauss-Newton's steps creep in range-only problems, and a solver's bound is short of a tight one by its tolerance.
    """
    space = problem.space
    found = minimise(form, reduced, form.lift(space.position(x), space.rotation(x))[: form.bound])
    return space.join(*form.drop(reduced.settle(found.X))), lower_bound(reduced, found.multipliers)[0]


def small(form: Quadratic) -> Quadratic:
    """The form, unless it has more than LARGEST constrained rows: then InputError."""
    if form.bound > LARGEST:
        hint = "Use staircase(problem): the same relaxation by low-rank factors."
        raise InputError("problem", f"{form.bound} constrained rows", f"must have at most {LARGEST}", hint)
    return form
