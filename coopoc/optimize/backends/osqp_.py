"""osqp: sequential quadratic programming with one workspace per structure, whose values are updated at every step.

Bounds on positions and displacements are rows l - h <= C dx <= u - h of each quadratic programme. The start is first
moved onto them by the least step; from then on every step keeps them, so that the cost alone decides between steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats
from ..algebra.sparse import Sparse, sparse
from ..assess.active import constraint_rows
from ..backend import Backend, Capabilities, Solver, SolverResult
from ..descent.descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, minimise
from ..model.constraint import bounded
from ..model.linear import Linear, local
from ..model.problem import Problem
from .osqp_programme import CLOSE, Infeasible, Programme, filled

FAR = 1e-6
"""Cost of a step of 1 m over that of a violation of 1 m, where none can be avoided."""


def prepare(
    structure: Problem,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
    kkt_tolerance: float = 1e-9,
) -> Solver:
    """Solver of a structure. A linear problem is a single quadratic programme.

    Args:
        structure: a problem whose structure counts, and its constraints.
        max_iterations: of quadratic programmes.
        tolerance: m, largest move of a point in the last step.
        kkt_tolerance: largest |P dx + q + C^T y| that is accepted, as a share of |q| or of the largest |P_ij dx_j|.

    >>> from coopoc.optimize import solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.constrain("displacement", ("a", "b"), upper=[7, 9, 9]), "osqp").x.round(3)[:, 0]
    array([1., 8.])
    """
    check_limits(max_iterations, tolerance)
    limits, programmes = _limits(structure), {}

    def solver(problem: Problem, x: Floats) -> SolverResult:
        system = sparse(problem)
        if system.layout not in programmes:
            programmes[system.layout] = _programme(system, limits, kkt_tolerance)
        programme, step_of = programmes[system.layout]
        step = step_of(system)
        if problem.constraints:
            try:
                x, feasible = _nearest(limits, x)
            except np.linalg.LinAlgError:
                return SolverResult(x, 0, extras=dict(programme.counts))
            if not feasible:
                return SolverResult(x, 0, True, dict(programme.counts))
        found = minimise(problem, step, x[None], max_iterations, tolerance)
        return SolverResult(
            found.x[0], int(np.ravel(found.iterations)[0]), extras=found.extras | dict(programme.counts)
        )

    return solver


def _programme(system: Sparse, limits: _Limits, tolerance: float) -> tuple[Programme, Callable[[Sparse], Step]]:
    """The quadratic programme of a structure, and the step of a problem that has it."""
    from scipy.sparse import csc_matrix

    entries = system.entries
    moving, diagonal = np.flatnonzero(entries.number.ravel() >= 0), entries.diagonal
    pattern = csc_matrix((np.ones(len(entries.indices)), entries.indices, entries.indptr), shape=(entries.size,) * 2)
    programme = Programme(csc_matrix(limits.matrix[:, moving]), tolerance)

    def step_of(system: Sparse) -> Step:
        def step(linear: Linear, damping: Floats) -> Floats:
            dx = np.zeros(damping.size)
            _, q, values = system.quadratic(linear.x[0], "gauss-newton")
            values, q = np.array(values), np.array(q)
            values[diagonal] += damping.ravel()[moving]
            if len(limits.lower):
                dx[moving] = programme.solve(filled(pattern, values), q, *limits.around(linear.x[0]))
            else:
                dx[moving] = programme.each(pattern, values[None], q[None])[0]
            return dx.reshape(damping.shape)

        return step

    return programme, step_of


@dataclass(frozen=True, eq=False)
class _Limits:
    """The constraints as rows lower - h(x) <= C dx <= upper - h(x): h is linear, C the same everywhere."""

    problem: Problem
    matrix: Any
    lower: Floats
    upper: Floats

    def around(self, x: Floats) -> tuple[Floats, Floats]:
        """Bounds of C dx at x (n, ambient)."""
        space, constraints = self.problem.space, self.problem.constraints
        seen = [local(space, c.measurement, x[None], c.nodes)[0][0][bounded(c)] for c in constraints]
        value = np.concatenate([np.empty(0), *seen])
        return self.lower - value, self.upper - value


def _limits(problem: Problem) -> _Limits:
    from scipy.sparse import csc_matrix

    n, space = len(problem.names), problem.space
    if not problem.constraints:
        return _Limits(problem, _none(n * space.dof), np.empty(0), np.empty(0))
    rows = constraint_rows(problem, np.zeros((n, space.ambient)))
    return _Limits(problem, csc_matrix(rows.matrix), rows.lower, rows.upper)


@lru_cache(maxsize=64)
def _none(columns: int) -> Any:
    from scipy.sparse import csc_matrix

    return csc_matrix((0, columns))


def _nearest(limits: _Limits, x: Floats) -> tuple[Floats, bool]:
    """x moved by the least step that satisfies the constraints and True; if there is none, by a step that violates them
    least, and False."""
    from scipy.sparse import csc_matrix, diags, eye, hstack

    lower, upper = limits.around(x)
    if np.all(lower <= 0) and np.all(upper >= 0):
        return x, True
    space, (rows, size) = limits.problem.space, limits.matrix.shape
    try:
        step = Programme(limits.matrix, CLOSE).solve(eye(size, format="csc"), np.zeros(size), lower, upper)
        return space.retract(x, step.reshape(len(x), -1)), True
    except Infeasible:
        slack = csc_matrix(hstack([limits.matrix, eye(rows)]))
        weight = diags(np.repeat([FAR, 1.0], [size, rows]), format="csc")
        step = Programme(slack, CLOSE).solve(weight, np.zeros(size + rows), lower, upper)[:size]
        return space.retract(x, step.reshape(len(x), -1)), False


BACKEND = Backend(
    "osqp",
    prepare,
    "sequential quadratic programming, persistent workspace",
    "osqp",
    Capabilities(constraints="linear"),
)
