"""One quadratic programme whose values are updated, solved by OSQP, its answers checked against their KKT conditions.

Settings matter: OSQP reports "solved" and can be a metre off when odometry weighs
5e5 times as much as GNSS. Scaling is off, the tolerance is tight, and every answer is checked against its own KKT
conditions and repaired where it fails. Without constraints over-relaxation is off too (alpha = 1: an iteration is then
a proximal step with the weight sigma, and 1.6 would make 40 of them out of one), and a repair is further iterations.
With them rho adapts, and a repair solves exactly for the active set that the iterations have found (polishing).
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from threading import get_ident
from typing import Any

import numpy as np

from ...arrays import Bools, Floats

SETTINGS = {
    "scaling": 0,
    "rho": 1e-4,
    "alpha": 1.0,
    "sigma": 1e-6,
    "eps_abs": 1e-12,
    "eps_rel": 1e-12,
    "max_iter": 200,
    "check_termination": 1,
    "polishing": False,
    "adaptive_rho": 0,
    "warm_starting": True,
    "verbose": False,
}
BOUNDED = {
    "rho": 0.1,
    "alpha": 1.6,
    "eps_abs": 1e-9,
    "eps_rel": 1e-9,
    "max_iter": 4000,
    "check_termination": 10,
    "polish_refine_iter": 10,
    "adaptive_rho": 1,
}
"""Settings that change under constraints."""
NEGLIGIBLE = 1e-11
"""m, an error of a coordinate that no tolerance asks to be smaller."""
CLOSE = 1e-9
"""m, by which a bound may be missed."""
REPAIRS = 5
"""Continuations of a quadratic programme before its answer is refused."""


class Infeasible(np.linalg.LinAlgError):
    """No step satisfies the bounds."""


class Workspace:
    """A problem of OSQP's extension module, whose values are updated.

    osqp's Python class around it copies 23 numbers of its report by their names at each solve: of 16 us for a star of
    ten, 9.
    """

    def __init__(self, half: Any, q: Floats, rows: Any, lower: Floats, upper: Floats) -> None:
        from osqp import ext_builtin as ext

        self._settings, self._limit = ext.OSQPSettings(), ext.OSQP_INFTY
        ext.osqp_set_default_settings(self._settings)
        for name, value in {**SETTINGS, **(BOUNDED if rows.shape[0] else {})}.items():
            setattr(self._settings, name, value)
        P, A, sides = ext.CSC(_short(half)), ext.CSC(_short(rows)), (self._finite(lower), self._finite(upper))
        self.solver = ext.OSQPSolver(P, q, A, *sides, *rows.shape, self._settings)
        self._zero = np.zeros(len(q))

    def update(self, values: Floats, q: Floats, lower: Floats | None = None, upper: Floats | None = None) -> None:
        """New numbers; all arrays contiguous."""
        if lower is not None and upper is not None:
            lower, upper = self._finite(lower), self._finite(upper)
        self.solver.update_data_vec(q, lower, upper)
        self.solver.update_data_mat(values, None, None, None)
        if lower is None:  # the workspace is kept: earlier solves must not show
            self.solver.warm_start(self._zero, None)

    def polish(self, wanted: bool) -> None:
        """Whether OSQP solves for its active set exactly."""
        self._settings.polishing = wanted
        self.solver.update_settings(self._settings)

    def _finite(self, side: Floats) -> Floats:
        return np.clip(side, -self._limit, self._limit)


class Programme:
    """min 1/2 dx^T P dx + q^T dx within lower <= C dx <= upper: one workspace, whose values are updated."""

    def __init__(self, rows: Any, tolerance: float) -> None:
        self._rows, self._tolerance = rows, tolerance
        self._workspace: Workspace | None = None
        self._polishing = False
        self.counts = {"osqp_iterations": 0, "repairs": 0}

    def solve(self, half: Any, q: Floats, lower: Floats, upper: Floats) -> Floats:
        """dx of the upper triangle of P (CSC).

        Raises:
            Infeasible: no dx satisfies the bounds. numpy.linalg.LinAlgError: the KKT conditions stay unsatisfied.
        """
        workspace = self._set(half, q, lower, upper)
        for attempt in range(REPAIRS + 1):
            answer = self._solve(workspace)
            if workspace.solver.info.status.startswith("primal infeasible"):
                raise Infeasible
            dx, y = np.array(answer.x), np.array(answer.y)
            active = bool(np.any((upper - self._rows @ dx < y) | (self._rows @ dx - lower < -y)))
            if self._holds(half, q, lower, upper, dx, y) and self._polishing >= active:
                return dx
            self.counts["repairs"] += attempt < REPAIRS and self._polishing >= active
            self._polish(workspace, active)
        raise np.linalg.LinAlgError("osqp: the KKT conditions of a quadratic programme stay unsatisfied")

    def each(self, half: Any, values: Floats, q: Floats) -> Floats:
        """dx (B, n) of programmes without bounds, their P the `values` (B, entries) in the places of `half`.

        The answers are checked together; one that fails is solved again and repaired, and is NaN where that fails too.
        """
        dx, nothing, structure = np.empty_like(q), np.empty(0), _raw(half)
        workspace = unbounded(*structure, get_ident())
        for b, now in enumerate(values):
            workspace.update(now, q[b])
            dx[b] = self._solve(workspace).x
        weight, product = self._product(structure, values, dx)
        for b in np.flatnonzero(~self._stationary(product + q, weight, q, dx)).tolist():
            try:
                dx[b] = self.solve(filled(half, values[b]), q[b], nothing, nothing)
            except np.linalg.LinAlgError:
                dx[b] = np.nan
        return dx

    def _set(self, half: Any, q: Floats, lower: Floats, upper: Floats) -> Workspace:
        if not self._rows.shape[0]:
            workspace = unbounded(*_raw(half), get_ident())
            workspace.update(half.data, q)
            return workspace
        if self._workspace is None:
            self._workspace = Workspace(half, q, self._rows, lower, upper)
        else:
            self._polish(self._workspace, False)
            self._workspace.update(half.data, q, lower, upper)
        return self._workspace

    def _solve(self, workspace: Workspace) -> Any:
        workspace.solver.solve()
        self.counts["osqp_iterations"] += int(workspace.solver.info.iter)
        return workspace.solver.solution

    def _polish(self, workspace: Workspace, wanted: bool) -> None:
        """Without an active set OSQP would print a message."""
        if wanted != self._polishing:
            self._polishing = wanted
            workspace.polish(wanted)

    def _holds(self, half: Any, q: Floats, lower: Floats, upper: Floats, dx: Floats, y: Floats) -> bool:
        """The KKT conditions, computed by ourselves: stationarity, bounds, and a push only where a bound is met."""
        weight, product = self._product(_raw(half), half.data[None], dx[None])
        if not self._stationary(product + q + self._rows.T @ y, weight, q[None], dx[None])[0]:
            return False
        weak = self._tolerance * _size(weight, q[None], dx[None])[0]
        value = self._rows @ dx
        kept = (value >= lower - CLOSE) & (value <= upper + CLOSE)
        active = ((y <= weak) | (value >= upper - CLOSE)) & ((y >= -weak) | (value <= lower + CLOSE))
        return bool(np.all(kept & active))

    def _product(self, structure: tuple[bytes, bytes], values: Floats, dx: Floats) -> tuple[Floats, Floats]:
        """Diagonal of P and P dx, (B, n)."""
        own, diagonal, entry, of, into = _places(*structure)
        weight = np.zeros_like(dx)
        weight[:, own] = values[:, diagonal]
        return weight, (into @ (values[:, entry] * dx[:, of]).T).T

    def _stationary(self, rest: Floats, weight: Floats, q: Floats, dx: Floats) -> Bools:
        """(B,) True where |P dx + q + C^T y|, the `rest` (B, n), is small."""
        allowed = self._tolerance * _size(weight, q, dx)[:, None] + NEGLIGIBLE * weight
        return np.asarray((np.abs(rest) <= allowed).all(axis=1))


def _short(matrix: Any) -> Any:
    """The sparse matrix with the short indices that OSQP takes; its numbers are shared, OSQP copies them."""
    found = copy(matrix)
    found.indices, found.indptr = (a.astype(np.int32, copy=False) for a in (matrix.indices, matrix.indptr))
    return found


@lru_cache(maxsize=64)
def unbounded(indices: bytes, indptr: bytes, thread: int) -> Workspace:
    """The workspace without bounds of a structure of P, set up once, its own for each thread; the values are I."""
    from scipy.sparse import csc_matrix

    row, start = np.frombuffer(indices, np.int32), np.frombuffer(indptr, np.int32)
    size = len(start) - 1
    identity = (row == np.repeat(np.arange(size), np.diff(start))).astype(np.float64)
    half = csc_matrix((identity, row, start), shape=(size, size))
    return Workspace(half, np.zeros(size), csc_matrix((0, size)), np.empty(0), np.empty(0))


def filled(half: Any, values: Floats) -> Any:
    """The sparse matrix with other values in its places."""
    found = copy(half)  # shares the structure
    found.data = values
    return found


def _raw(half: Any) -> tuple[bytes, bytes]:
    """The structure of P as a key."""
    return half.indices.astype(np.int32).tobytes(), half.indptr.astype(np.int32).tobytes()


def _size(weight: Floats, q: Floats, dx: Floats) -> Floats:
    """(B,) of what adds up in P dx + q."""
    return np.asarray(np.maximum(np.abs(q).max(axis=1), np.abs(weight * dx).max(axis=1)))


@lru_cache(maxsize=64)
def _places(indices: bytes, indptr: bytes) -> tuple[Any, ...]:
    """Of the upper triangle of P: diagonal rows and entries; of all of P the entries, their columns, and what adds them
    up by rows."""
    from scipy.sparse import csr_array

    row, start = np.frombuffer(indices, np.int32), np.frombuffer(indptr, np.int32)
    col = np.repeat(np.arange(len(start) - 1), np.diff(start))
    diagonal, off = np.flatnonzero(row == col), np.flatnonzero(row != col)
    entry, to = np.append(np.arange(len(col)), off), np.append(row, col[off])
    into = csr_array((np.ones(len(to)), (to, np.arange(len(to)))), shape=(len(start) - 1, len(to)))
    return col[diagonal], diagonal, entry, np.append(col, row[off]), into
