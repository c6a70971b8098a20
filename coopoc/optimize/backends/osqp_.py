"""osqp: sequential quadratic programming with one workspace per structure, whose values are updated at every step.

Bounds on positions and displacements are rows l - h <= C dx <= u - h of each quadratic programme. The start is first
moved onto them by the least step; from then on every step keeps them, so that the cost alone says which step is better.

Settings matter (performance.md G4 of the design notes): OSQP says "solved" and can be a metre off when odometry weighs
5e5 times as much as GNSS. Scaling is off, the tolerance is tight, and every answer is held against its own KKT
conditions and repaired where it fails. Without constraints over-relaxation is off too (alpha = 1: an iteration is then
a proximal step with the weight sigma, and 1.6 would make 40 of them out of one), and a repair is further iterations.
With them rho adapts, and a repair solves exactly for the active set that the iterations have found (polishing).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Bools, Floats
from ..active import bounded, constraint_rows
from ..arrowhead import structure
from ..descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, descend
from ..linear import Linear
from ..local import local
from ..normal import Pattern, normal_equations
from ..problem import Problem
from .run import Ended, Run

SETTINGS = {
    "scaling": 0, "rho": 1e-4, "alpha": 1.0, "sigma": 1e-6, "eps_abs": 1e-12, "eps_rel": 1e-12, "max_iter": 200,
    "check_termination": 1, "polishing": False, "adaptive_rho": 0, "warm_starting": True, "verbose": False,
}  # fmt: skip
BOUNDED = {
    "rho": 0.1, "alpha": 1.6, "eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 4000, "check_termination": 10,
    "polish_refine_iter": 10, "adaptive_rho": 1,
}  # fmt: skip
"""What changes where there are constraints."""
NEGLIGIBLE = 1e-11
"""m, an error of a coordinate that no tolerance asks to be smaller."""
CLOSE = 1e-9
"""m, by which a bound may be missed."""
REPAIRS = 5
"""How often a quadratic programme is continued before its answer is refused."""


FAR = 1e-6
"""What a step of 1 m costs beside a violation of 1 m, where none can be avoided."""


class Infeasible(np.linalg.LinAlgError):
    """No step satisfies the bounds."""


def build(
    problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE, kkt_tolerance: float = 1e-9
) -> Run:
    """Solver of one problem. A linear one is a single quadratic programme.

    Args:
        max_iterations: of quadratic programmes. tolerance: m, largest move of a point in the last step.
        kkt_tolerance: largest |P dx + q + C^T y| that is accepted, as a share of |q| or of the largest |P_ij dx_j|.

    >>> from coopoc.optimize import solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.constrain("displacement", ("a", "b"), upper=[7, 9, 9]), "osqp").x.round(3)[:, 0]
    array([1., 8.])
    """
    check_limits(max_iterations, tolerance)
    limits = _limits(problem)
    programme, step = _programme(problem, limits, kkt_tolerance)

    def run(x: Floats) -> Ended:
        try:
            x, feasible = _nearest(limits, x)
            if not feasible:
                return Ended(x, 0, dict(programme.counts), infeasible=True)
            if problem.linear and max_iterations:
                dx = step(problem.linearise(x[None]), np.zeros((1, len(x), problem.space.dof)))
                return Ended(problem.space.retract(x, dx[0]), 1, dict(programme.counts))
        except np.linalg.LinAlgError:
            return Ended(x, 0, dict(programme.counts))
        end = descend(problem, step, x[None], max_iterations, tolerance)
        return Ended(end.x[0], int(end.iterations[0]), dict(programme.counts))

    return run


def linear_step(problem: Problem, kkt_tolerance: float = 1e-9) -> Step:
    """The quadratic programme without constraints of each realisation, one after the other in one workspace."""
    return _programme(problem, _limits(problem.having(constraints=())), kkt_tolerance)[1]


def _programme(problem: Problem, limits: _Limits, tolerance: float) -> tuple[_Programme, Step]:
    scheme, _ = structure(problem)
    pattern, source = _upper(scheme, problem.space.dof)
    upper = pattern.copy()
    nodes, at_own = [f.nodes for f in problem.factors], np.arange(problem.space.dof)
    own = np.flatnonzero(scheme.pairs[:, 0] == scheme.pairs[:, 1])
    at = scheme.pairs[own, 0]
    programme = _Programme(limits.matrix, tolerance)

    def step(linear: Linear, damping: Floats) -> Floats:
        blocks, gradient = normal_equations(scheme, linear, nodes)
        if damping.any():
            blocks[:, own[:, None], at_own, at_own] += damping[:, at]
        values, q = blocks.reshape(len(blocks), -1)[:, source], gradient.reshape(len(gradient), -1)
        if not len(limits.lower):
            return programme.each(upper, values, q).reshape(damping.shape)
        upper.data[:] = values[0]
        return programme.solve(upper, q[0], *limits.around(linear.x[0])).reshape(damping.shape)

    return programme, step


@dataclass(frozen=True, eq=False)
class _Limits:
    """The constraints as rows lower - h(x) <= C dx <= upper - h(x): h is linear, C the same everywhere."""

    problem: Problem
    matrix: Any
    lower: Floats
    upper: Floats

    def around(self, x: Floats) -> tuple[Floats, Floats]:
        """What C dx may be at x (n, width)."""
        space, constraints = self.problem.space, self.problem.constraints
        seen = [local(space, c.measurement, x[None], c.nodes)[0][0][bounded(c)] for c in constraints]
        value = np.concatenate([np.empty(0), *seen])
        return self.lower - value, self.upper - value


def _limits(problem: Problem) -> _Limits:
    from scipy.sparse import csc_matrix

    n, space = len(problem.names), problem.space
    if not problem.constraints:
        return _Limits(problem, csc_matrix((0, n * space.dof)), np.empty(0), np.empty(0))
    rows = constraint_rows(problem, np.zeros((n, space.width)))
    return _Limits(problem, csc_matrix(rows.matrix), rows.lower, rows.upper)


def _nearest(limits: _Limits, x: Floats) -> tuple[Floats, bool]:
    """x moved by the least step that satisfies the constraints and True; if there is none, by a step that violates them
    least, and False."""
    from scipy.sparse import csc_matrix, diags, eye, hstack

    lower, upper = limits.around(x)
    if np.all(lower <= 0) and np.all(upper >= 0):
        return x, True
    space, (rows, size) = limits.problem.space, limits.matrix.shape
    try:
        step = _Programme(limits.matrix, CLOSE).solve(eye(size, format="csc"), np.zeros(size), lower, upper)
        return space.retract(x, step.reshape(len(x), -1)), True
    except Infeasible:
        slack = csc_matrix(hstack([limits.matrix, eye(rows)]))
        weight = diags(np.repeat([FAR, 1.0], [size, rows]), format="csc")
        step = _Programme(slack, CLOSE).solve(weight, np.zeros(size + rows), lower, upper)[:size]
        return space.retract(x, step.reshape(len(x), -1)), False


class _Programme:
    """min 1/2 dx^T P dx + q^T dx within lower <= C dx <= upper: one workspace, whose values are updated."""

    def __init__(self, rows: Any, tolerance: float) -> None:
        self._rows, self._tolerance = rows, tolerance
        self._solver: Any = None
        self._places: tuple[Any, ...] | None = None
        self._polishing = False
        self.counts = {"osqp_iterations": 0, "repairs": 0}

    def solve(self, half: Any, q: Floats, lower: Floats, upper: Floats) -> Floats:
        """dx of the upper triangle of P (CSC).

        Raises:
            Infeasible: no dx satisfies the bounds. numpy.linalg.LinAlgError: the KKT conditions stay unsatisfied.
        """
        self._set(half, q, lower, upper)
        for attempt in range(REPAIRS + 1):
            answer = self._answer()
            if answer.info.status.startswith("primal infeasible"):
                raise Infeasible
            dx, y = np.asarray(answer.x, dtype=np.float64), np.asarray(answer.y, dtype=np.float64)
            pushed = bool(np.any((upper - self._rows @ dx < y) | (self._rows @ dx - lower < -y)))
            if self._holds(half, q, lower, upper, dx, y) and self._polishing >= pushed:
                return dx
            self.counts["repairs"] += attempt < REPAIRS and self._polishing >= pushed
            self._polish(pushed)
        raise np.linalg.LinAlgError("osqp: the KKT conditions of a quadratic programme stay unsatisfied")

    def each(self, half: Any, values: Floats, q: Floats) -> Floats:
        """dx (B, n) of programmes without bounds, their P the `values` (B, entries) in the places of `half`.

        The answers are checked together; one that fails is solved again and repaired, and is NaN where that fails too.
        """
        dx, nothing = np.empty_like(q), np.empty(0)
        for b, half.data[:] in enumerate(values):
            self._set(half, q[b], nothing, nothing)
            dx[b] = self._answer().x
        weight, force = self._product(half, values, dx)
        for b in np.flatnonzero(~self._stationary(force + q, weight, q, dx)).tolist():
            half.data[:] = values[b]
            try:
                dx[b] = self.solve(half, q[b], nothing, nothing)
            except np.linalg.LinAlgError:
                dx[b] = np.nan
        return dx

    def _set(self, half: Any, q: Floats, lower: Floats, upper: Floats) -> None:
        if self._solver is None:
            import osqp

            self._solver = osqp.OSQP(algebra="builtin")  # without a name it tries to import every other at each call
            settings = {**SETTINGS, **(BOUNDED if self._rows.shape[0] else {})}
            self._solver.setup(P=half.copy(), q=q, A=self._rows, l=lower, u=upper, **settings)
        elif self._rows.shape[0]:
            self._polish(False)
            self._solver.update(Px=half.data, q=q, l=lower, u=upper)
        else:
            self._solver.update(Px=half.data, q=q)

    def _answer(self) -> Any:
        answer = self._solver.solve(raise_error=False)
        self.counts["osqp_iterations"] += int(answer.info.iter)
        return answer

    def _polish(self, wanted: bool) -> None:
        """Whether OSQP solves for its active set exactly; without one it would print that on stdout."""
        if wanted != self._polishing:
            self._polishing = wanted
            self._solver.update_settings(polishing=wanted)

    def _holds(self, half: Any, q: Floats, lower: Floats, upper: Floats, dx: Floats, y: Floats) -> bool:
        """The KKT conditions, computed by ourselves: stationarity, bounds, and a push only where a bound is met."""
        weight, force = self._product(half, half.data[None], dx[None])
        if not self._stationary(force + q + self._rows.T @ y, weight, q[None], dx[None])[0]:
            return False
        weak = self._tolerance * _size(weight, q[None], dx[None])[0]
        value = self._rows @ dx
        kept = (value >= lower - CLOSE) & (value <= upper + CLOSE)
        pushed = ((y <= weak) | (value >= upper - CLOSE)) & ((y >= -weak) | (value <= lower + CLOSE))
        return bool(np.all(kept & pushed))

    def _product(self, half: Any, values: Floats, dx: Floats) -> tuple[Floats, Floats]:
        """Diagonal of P and P dx, (B, n)."""
        if self._places is None:
            self._places = _places(half)
        own, diagonal, entry, of, into = self._places
        weight = np.zeros_like(dx)
        weight[:, own] = values[:, diagonal]
        return weight, (into @ (values[:, entry] * dx[:, of]).T).T

    def _stationary(self, rest: Floats, weight: Floats, q: Floats, dx: Floats) -> Bools:
        """(B,) True where |P dx + q + C^T y|, the `rest` (B, n), is small."""
        allowed = self._tolerance * _size(weight, q, dx)[:, None] + NEGLIGIBLE * weight
        return np.asarray((np.abs(rest) <= allowed).all(axis=1))


def _size(weight: Floats, q: Floats, dx: Floats) -> Floats:
    """(B,) of what adds up in P dx + q."""
    return np.asarray(np.maximum(np.abs(q).max(axis=1), np.abs(weight * dx).max(axis=1)))


def _places(half: Any) -> tuple[Any, ...]:
    """Of the upper triangle of P: diagonal rows and entries; of all of P the entries, their columns, and what adds them
    up by rows."""
    from scipy.sparse import csr_array

    col = np.repeat(np.arange(half.shape[1]), np.diff(half.indptr))
    diagonal = np.flatnonzero(half.indices == col)
    off = np.flatnonzero(half.indices != col)
    entry, to = np.append(np.arange(len(col)), off), np.append(half.indices, col[off])
    into = csr_array((np.ones(len(to)), (to, np.arange(len(to)))), shape=(half.shape[1], len(to)))
    return col[diagonal], diagonal, entry, np.append(col, half.indices[off]), into


@lru_cache(maxsize=64)
def _upper(scheme: Pattern, dof: int) -> tuple[Any, Any]:
    """Upper triangle of J^T J as CSC with its structure, and where each value lies in the flat blocks."""
    from scipy.sparse import csc_array, csc_matrix

    i, j = scheme.pairs.T
    row = np.broadcast_to(dof * i[:, None, None] + np.arange(dof)[:, None], (len(i), dof, dof)).ravel()
    col = np.broadcast_to(dof * j[:, None, None] + np.arange(dof), (len(i), dof, dof)).ravel()
    flat = np.arange(dof * dof * len(i))
    keep = row <= col
    shape = (dof * scheme.nodes, dof * scheme.nodes)
    numbered = csc_array((flat[keep] + 1.0, (row[keep], col[keep])), shape=shape)
    numbered.sort_indices()
    return csc_matrix(numbered), (numbered.data - 1).astype(np.int64)
