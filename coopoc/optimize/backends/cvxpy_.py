"""cvxpy: linear problems as a quadratic programme; ranges and poses by a convex relaxation, rounded and refined.

Every programme has parameters (CVXPY's DPP rules) and is built once per shape. The semidefinite one is the primal of
the one that `shor` solves, so that the two check each other. The refinement is ours: the trust region of manifold.py,
then Gauss-Newton; the extras hold the point of the relaxation before it.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ...plugins import one_of
from ..backend import Backend, Capabilities, Solver, SolverResult, looped
from ..convex.qcqp import Multipliers
from ..convex.quadratic import TERMS, quadratic
from ..convex.relaxation import first_vectors, polished, rounded, small
from ..convex.schur import Dense, lower_bound
from ..model.linear import entries
from ..model.problem import Problem
from . import gauss_newton

RELAXATIONS = ("auto", "qp", "sdp")
SOLVER = {"solver": "CLARABEL", "tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10, "max_threads": 1}


def prepare(structure: Problem, relaxation: str = "auto", refine: bool = True) -> Solver:
    """Solver of a structure.

    Args:
        structure: a problem whose structure counts.
        relaxation: "qp" (linear problems) or "sdp" (Shor); "auto": qp, else sdp.
        refine: from the rounded point to a minimum; without it the answer is the relaxation's own. A qp needs none.

    Raises:
        InputError: an unknown relaxation, or a problem that it cannot take: it lists what it can.
    """
    one_of("relaxation", relaxation, RELAXATIONS)
    convex = structure.linear and not structure.poses
    if relaxation == "qp" and not convex:
        raise InputError("relaxation", "'qp'", "needs points and only position and displacement", "Use sdp.")
    return _linear if convex and relaxation != "sdp" else looped(partial(_relaxed, refine))


def _relaxed(refine: bool, problem: Problem, x: Floats) -> SolverResult:
    """Shor's relaxation, rounded and, if `refine`, followed to a minimum; x is not looked at."""
    began, form = time.perf_counter(), small(quadratic(problem))
    reduced = Dense(form)
    stiefel, sphere, Z, count = _sdp(form.stiefel.shape, form.sphere.shape)(reduced.matrix)
    bound, *_ = lower_bound(reduced, Multipliers(form, stiefel, sphere))
    found = rounded(problem, form, reduced, *first_vectors(Z, form.columns), bound, began, refine=False)
    extras = {
        "relaxation": "sdp",
        "lower_bound": found.lower_bound,
        "rank_gap": found.rank_gap,
        "rounded_cost": found.cost,
        "refined": refine,
    }
    if not refine:
        return SolverResult(found.x, count, extras=extras)
    near = polished(problem, form, reduced, found.x)[0]
    return SolverResult(gauss_newton.prepare(problem)(problem, near[None]).x[0], count, extras=extras)


def _linear(problem: Problem, x: Floats) -> SolverResult:
    """Quadratic programmes; of x (B, n, ambient) only what is fixed counts: they begin away from it, as it may be the
    answer."""
    batch, n, d = x.shape
    free = np.ones((n, d), dtype=bool) if problem.movable is None else problem.movable
    moved = np.where(free, x.mean(axis=1, keepdims=True), x)
    linear = problem.linearise(moved)
    data, row, col = entries(linear, problem.factors, d)
    kept, place = free.ravel()[col], np.cumsum(free.ravel()) - 1
    rest = np.concatenate([r.reshape(batch, -1) for r in linear.residual], axis=1)
    solve = _qp(rest.shape[1], int(free.sum()), row[kept].tobytes(), place[col[kept]].tobytes())
    steps = [solve(*given) for given in zip(data[:, kept], rest, strict=True)]
    moved[:, free] += np.stack([step for step, _ in steps])
    counts = np.array([count for _, count in steps])
    return SolverResult(moved, counts, extras={"relaxation": "qp", "refined": False})


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
        return (
            -scale * 0.5 * (duals + np.swapaxes(duals, 1, 2)),
            -scale * spheres,
            np.asarray(Z.value),
            int(programme.solver_stats.num_iters),
        )

    return run


BACKEND = Backend(
    "cvxpy",
    prepare,
    "convex relaxations: the QP, Shor's SDP with a lower bound",
    "cvxpy",
    Capabilities(batched=True, kinds=tuple(TERMS), losses=()),
)
