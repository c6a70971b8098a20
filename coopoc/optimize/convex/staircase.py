"""staircase: Shor's relaxation of a large problem by low-rank factors, from any start (Burer and Monteiro)."""

from __future__ import annotations

import time

import numpy as np
from tqdm import tqdm

from ...arrays import Floats
from ...errors import InputError
from ..algebra.cholesky import cholesky_of
from ..model.problem import Problem
from .manifold import Stationary, minimise, retract
from .newton import minimise_sparsely
from .qcqp import Multipliers, Quadratic
from .quadratic import quadratic
from .relaxation import TIGHT, Relaxation, rounded
from .schur import Reduced, Sparse, lower_bound, reduce

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


def staircase(
    problem: Problem, refine: bool = True, seed: int = 0, height: int = HEIGHT, seconds: float = np.inf
) -> Relaxation:
    """The semidefinite relaxation of `shor` with Z = Y Y^T, Y of a few columns, rounded and refined.

    minimise 1/2 <C, Y Y^T> over Y with p columns; if C - L has a negative eigenvalue there, its eigenvector in a new
    column p + 1 leads down, else the relaxation is solved: whatever the start, the bound is that of `shor` (CORA, arXiv
    2302.11614). Poses need not be known even roughly: the start is random unless the problem
    has an x0. A thousand poses take seconds.

    Args:
        problem: one that `quadratic` takes.
        refine: follow by `solve` from the rounded point.
        seed: of the random start.
        height: columns beyond d at which to give up.
        seconds: after which to stop, with the best bound by then; for graphs, a small problem takes what it needs.

    Raises:
        InputError: as `quadratic`; height below 1, seconds that are not positive.

    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> round(staircase(problem.add("range", ("a", "b"), 6.0, std=1.0)).lower_bound, 6)
    0.666667
    """
    if not isinstance(height, int) or height < 1:
        raise InputError("height", height, "must be a whole number >= 1", f"Leave it out for {HEIGHT}.")
    if not seconds > 0:
        raise InputError("seconds", seconds, "must be positive", "Leave it out for as long as it takes.")
    began = time.perf_counter()
    form = quadratic(problem)
    reduced = reduce(form)
    start = _start(problem, form, seed)
    found, bound = climb(form, reduced, start, form.columns + height, began + seconds)
    _, values, rows = np.linalg.svd(found.X, full_matrices=False)
    d = form.columns
    gap = float(np.square(values[d] / max(values[d - 1], 1e-300))) if len(values) > d else 0.0
    return rounded(problem, form, reduced, found.X @ rows[:d].T, gap, bound, began, refine)


def _start(problem: Problem, form: Quadratic, seed: int) -> Floats:
    if problem.x0 is None:
        random = np.random.default_rng(seed).standard_normal((form.bound, form.columns + START))
        return form.project(random)
    where = problem.space
    return form.lift(where.position(problem.x0), where.rotation(problem.x0))[: form.bound]


def climb(form: Quadratic, reduced: Reduced, Y: Floats, most: int, deadline: float) -> tuple[Stationary, float]:
    """A stationary point and the best bound on the way; the two agree, unless `most` columns, rounding or the time
    (time.perf_counter() of the `deadline`) stop it."""
    bound, before = -np.inf, np.inf
    with tqdm(desc="staircase", unit=" steps", delay=2.0) as bar:
        while True:
            if isinstance(reduced, Sparse):
                found = minimise_sparsely(form, reduced, Y, deadline=deadline, tick=bar.update)
            else:
                found = minimise(form, reduced, Y, tick=bar.update)
            proved, smallest, vector = lower_bound(reduced, found.multipliers)
            bound, size = max(bound, proved), max(found.cost, 1.0)
            if isinstance(reduced, Sparse) and found.cost - proved > FAR * size:
                bound = max(bound, scaled_bound(reduced, found.multipliers))
            late = Y.shape[1] >= most or time.perf_counter() > deadline
            if late or found.cost - bound <= TIGHT * size or before - found.cost <= STALL * size:
                return found, bound
            bar.set_postfix(columns=Y.shape[1] + 1, cost=f"{found.cost:.6g}", bound=f"{max(bound, 0.0):.6g}")
            Y, before = _escape(form, reduced, found, smallest, vector), found.cost


def scaled_bound(reduced: Sparse, L: Multipliers) -> float:
    """1/2 a tr L with the largest share a in [0, 1) of the multipliers for which C - a L is positive semidefinite.

    Such multipliers are feasible, whatever L. Where C - L is indefinite in a few directions they prove more than a
    shift of all rows by the smallest eigenvalue.
    """
    share, fails, less = 0.0, 1.0, L.sparse
    shift = ROUNDING * reduced.scale
    for _ in range(BISECTIONS):
        middle = 0.5 * (share + fails)
        if cholesky_of(reduced.shifted(middle * less, -shift)) is None:
            fails = middle
        else:
            share = middle
    return 0.5 * (share * L.trace - shift * L.problem.trace)


def _escape(form: Quadratic, reduced: Reduced, found: Stationary, smallest: float, v: Floats) -> Floats:
    """A lower point with one more column: along v the cost is cost + 1/2 smallest a^2 + O(a^3)."""
    wide = np.column_stack([found.X, np.zeros(len(v))])
    along = np.zeros_like(wide)
    along[:, -1] = v
    reach = np.sqrt(form.bound)
    while True:
        Y = retract(form, wide, reach * along)
        cost = 0.5 * float(np.sum(Y * reduced.times(Y)))
        if cost <= found.cost + 0.125 * smallest * reach * reach or reach < 1e-6:
            return Y
        reach *= 0.5
