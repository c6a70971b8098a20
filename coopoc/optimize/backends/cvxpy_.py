"""cvxpy: linear problems as a quadratic programme; ranges and poses by a convex relaxation, rounded and refined.

Every programme has parameters (CVXPY's DPP rules) and is built once per shape. The semidefinite one is the primal of
the one that `shor` solves, so that the two check each other. The refinement is ours: the trust region of manifold.py,
then Gauss-Newton; the extras say what the relaxation had found before it.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..convex.certificate import lower_bound
from ..convex.qcqp import Multipliers, Quadratic
from ..convex.quadratic import quadratic
from ..convex.relaxation import first_vectors, framed, in_balls, polished, rounded, small
from ..convex.schur import Dense
from ..linear import entries
from ..problem import Problem
from .gauss_newton import build as gauss_newton
from .run import Ended, Run

RELAXATIONS = ("auto", "qp", "socp", "sdp")
SOLVER = {"solver": "CLARABEL", "tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10, "max_threads": 1}


def build(problem: Problem, relaxation: str = "auto", refine: bool = True) -> Run:
    """Solver of one problem.

    Args:
        relaxation: "qp" (linear problems), "sdp" (Shor) or "socp" (balls in place of spheres); "auto": qp, else sdp.
        refine: from the rounded point to a minimum; without it the answer is the relaxation's own. A qp needs none.

    Raises:
        InputError: an unknown relaxation, or a problem that it cannot take: it lists what it can.
    """
    if relaxation not in RELAXATIONS:
        raise InputError("relaxation", repr(relaxation), f"must be one of {RELAXATIONS}", "Leave it out for auto.")
    if relaxation == "auto":
        relaxation = "qp" if problem.linear and not problem.poses else "sdp"
    if relaxation == "qp":
        if not problem.linear or problem.poses:
            raise InputError("relaxation", "'qp'", "needs points and only position and displacement", "Use sdp.")
        return lambda x: _linear(problem, x[None])[0]
    form = small(quadratic(problem))
    relax = _balls(framed(form)) if relaxation == "socp" else _semidefinite(form)

    def run(x: Floats) -> Ended:
        began = time.perf_counter()
        reduced = Dense(form)
        X, bound, gap, count = relax(reduced)
        found = rounded(problem, form, reduced, X, bound, gap, began, refine=False)
        extras = {"relaxation": relaxation, "lower_bound": found.lower_bound, "rank_gap": found.rank_gap,
                  "rounded_cost": found.cost, "refined": refine}  # fmt: skip
        x = gauss_newton(problem)(polished(problem, form, reduced, found.x)[0]).x if refine else found.x
        return Ended(x, count, extras)

    return run


def _semidefinite(form: Quadratic) -> Callable[[Dense], tuple[Floats, float, float, int]]:
    """X of rank d, lower bound, rank gap and iterations of Shor's relaxation."""
    programme = _sdp(form.stiefel.shape, form.sphere.shape)

    def relax(reduced: Dense) -> tuple[Floats, float, float, int]:
        stiefel, sphere, Z, count = programme(reduced.matrix)
        bound, *_ = lower_bound(reduced, Multipliers(form, stiefel, sphere))
        X, gap = first_vectors(Z, form.columns)
        return X, bound, gap, count

    return relax


def each(problem: Problem, x: Floats, relaxation: str = "auto", refine: bool = True) -> list[Ended]:
    """`build` of B realisations from x (B, n, width): linear problems share all but the solution."""
    if problem.linear and not problem.poses and relaxation in ("auto", "qp"):
        return _linear(problem, x)
    parts = [problem.pick(b) for b in range(len(x))] if problem.batch else [problem]
    return [build(part, relaxation, refine)(start) for part, start in zip(parts, x, strict=True)]


def _linear(problem: Problem, x: Floats) -> list[Ended]:
    """Of x (B, n, width) only what is held counts: the programmes begin away from it, as it may be the answer."""
    batch, n, d = x.shape
    free = np.ones((n, d), dtype=bool) if problem.free is None else problem.free
    moved = np.where(free, x.mean(axis=1, keepdims=True), x)
    linear = problem.linearise(moved)
    data, row, col = entries(linear, problem.factors, d)
    kept, place = free.ravel()[col], np.cumsum(free.ravel()) - 1
    rest = np.concatenate([r.reshape(batch, -1) for r in linear.residual], axis=1)
    solve = _qp(rest.shape[1], int(free.sum()), row[kept].tobytes(), place[col[kept]].tobytes())
    steps = [solve(*given) for given in zip(data[:, kept], rest, strict=True)]
    moved[:, free] += np.stack([step for step, _ in steps])
    extras = {"relaxation": "qp", "refined": False}
    return [Ended(end, count, dict(extras)) for end, (_, count) in zip(moved, steps, strict=True)]


def _cvxpy() -> Any:
    return importlib.import_module("cvxpy")


@lru_cache(maxsize=64)
def _qp(rows: int, size: int, row: bytes, col: bytes) -> Callable[[Floats, Floats], tuple[Floats, int]]:
    """Solver of min 1/2 |r + J dx|^2 for the entries of J in the given places, and r."""
    cp = _cvxpy()
    from scipy.sparse import csr_array

    at, of = np.frombuffer(row, np.int64), np.frombuffer(col, np.int64)
    into = csr_array((np.ones(len(at)), (at, np.arange(len(at)))), shape=(rows, len(at)))
    entries, r, dx = cp.Parameter(len(at)), cp.Parameter(rows), cp.Variable(size)
    programme = cp.Problem(cp.Minimize(0.5 * cp.sum_squares(r + into @ cp.multiply(entries, dx[of]))))

    def run(values: Floats, residual: Floats) -> tuple[Floats, int]:
        scale = max(float(np.abs(residual).max()), 1e-300)
        entries.value, r.value = values, residual / scale
        programme.solve(**SOLVER)
        return scale * np.asarray(dx.value), int(programme.solver_stats.num_iters)

    return run


@lru_cache(maxsize=64)
def _sdp(stiefel: tuple[int, int], sphere: tuple[int, int]) -> Callable[[Floats], tuple[Floats, Floats, Floats, int]]:
    """Solver of min 1/2 <C, Z>: it returns the multipliers of both kinds of block, Z and the iterations."""
    cp = _cvxpy()

    (n, k), (m, q) = stiefel, sphere
    size = n * k + m * q
    C, Z = cp.Parameter((size, size), symmetric=True), cp.Variable((size, size), PSD=True)
    blocks = [Z[k * b : k * b + k, k * b : k * b + k] == np.eye(k) for b in range(n)]
    diagonal = cp.diag(Z)[n * k :]
    units = cp.sum(cp.reshape(diagonal, (m, q), order="C"), axis=1) == 1 if m else None
    programme = cp.Problem(cp.Minimize(cp.sum(cp.multiply(C, Z))), [*blocks, *([] if units is None else [units])])

    def run(cost: Floats) -> tuple[Floats, Floats, Floats, int]:
        scale = max(float(np.trace(cost)) / size, 1e-300)
        C.value = 0.5 * (cost + cost.T) / scale
        programme.solve(**SOLVER)
        duals = np.array([block.dual_value for block in blocks]).reshape(n, k, k)
        spheres = np.zeros(0) if units is None else np.asarray(units.dual_value)
        return (-scale * 0.5 * (duals + np.swapaxes(duals, 1, 2)), -scale * spheres, np.asarray(Z.value),
                int(programme.solver_stats.num_iters))  # fmt: skip

    return run


def _balls(form: Quadratic) -> Callable[[Dense], tuple[Floats, float, float, int]]:
    """The same of the ball relaxation: min 1/2 <C, [I; s] [I; s]^T> over |s_e| <= 1."""
    programme = _socp(form.stiefel.size, form.columns, form.sphere.shape)

    def relax(reduced: Dense) -> tuple[Floats, float, float, int]:
        s, count = programme(reduced.matrix)
        return *in_balls(form, reduced, s), count

    return relax


@lru_cache(maxsize=64)
def _socp(frame: int, columns: int, sphere: tuple[int, int]) -> Callable[[Floats], tuple[Floats, int]]:
    cp = _cvxpy()

    m, q = sphere
    root = cp.Parameter((frame + m * q, frame + m * q))
    s = cp.Variable((m * q, columns))
    balls = [cp.norm(s[q * e : q * e + q], "fro") <= 1 for e in range(m)]
    residual = root[:, :frame] @ np.eye(frame, columns) + root[:, frame:] @ s
    programme = cp.Problem(cp.Minimize(0.5 * cp.sum_squares(residual)), balls)

    def run(cost: Floats) -> tuple[Floats, int]:
        values, vectors = np.linalg.eigh(cost)
        root.value = np.sqrt(np.maximum(values, 0.0) / max(float(values[-1]), 1e-300))[:, None] * vectors.T
        programme.solve(**SOLVER)
        return np.asarray(s.value), int(programme.solver_stats.num_iters)

    return run
