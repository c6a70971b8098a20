"""osqp: sequential quadratic programming with one workspace per solve, whose values are updated at every step.

Bounds on positions and displacements are rows l - h <= C dx <= u - h of each quadratic programme, with one C. The start
is first moved onto them by the least step; from then on every step keeps them, so that the cost alone decides between
steps.

Settings matter: OSQP reports "solved" and can be a metre off when odometry weighs 5e5 times as much as GNSS. Scaling is
off, the tolerance is tight, and every answer is checked against its own KKT conditions and repaired where it fails.
The bounds weigh as much as what is known best (rho), else the active set is not found. Over-relaxation is off and the
proximal weight sigma vanishes: without constraints an iteration is then a Newton step. A repair solves exactly for the
active set that the iterations have found (polishing).
"""

from typing import Any

import numpy as np
from numpy.linalg import LinAlgError

from ...arrays import Floats
from ..algebra.sparse import sparse
from ..assess.active import constraint_rows
from ..backend import MAX_ITERATIONS, SOLVER_STEP_TOLERANCE, Backend, Capabilities, SolverResult
from ..descent.levenberg_marquardt import arrive
from ..model.problem import Problem

SETTINGS = {
    "scaling": 0,
    "alpha": 1.0,
    "sigma": 1e-15,
    "eps_abs": 1e-9,
    "eps_rel": 1e-9,
    "check_termination": 1,
    "polish_refine_iter": 10,
    "verbose": False,
}
NEGLIGIBLE = 1e-11
"""m, an error of a coordinate that no tolerance asks to be smaller."""
BOUND_TOLERANCE = 1e-9
"""m, by which a bound may be missed."""
KKT = 1e-9
"""Largest |P dx + q + C^T y| that is accepted, as a share of |q| or of the largest |P_ij dx_j|."""
REPAIRS = 5
"""Continuations of a quadratic programme before its answer is refused."""
STEP_WEIGHT = 1e-6
"""Cost of a step of 1 m over that of a violation of 1 m, where none can be avoided."""


def solver(
    problem: Problem, x: Floats, max_iterations: int = MAX_ITERATIONS, tolerance: float = SOLVER_STEP_TOLERANCE
) -> SolverResult:
    """Solve a problem from x (n, ambient). A linear problem is a single quadratic programme.

    Args:
        problem: that is solved.
        x: start.
        max_iterations: of quadratic programmes.
        tolerance: m, largest move of a point in the last step.

    >>> from coopoc.optimize import solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> solve(problem.constrain("displacement", ("a", "b"), upper=[7, 9, 9]), "osqp").x.round(3)[:, 0]
    array([1., 8.])
    """
    from osqp import OSQPException
    from scipy.sparse import csc_matrix

    system, held = sparse(problem), bool(problem.constraints)
    entries = system.entries
    pattern = csc_matrix((np.ones(len(entries.indices)), entries.indices, entries.indptr), shape=(entries.size,) * 2)
    matrix = csc_matrix((0, entries.size))
    if held:
        matrix = csc_matrix(constraint_rows(problem, x).matrix)[:, problem.movable.ravel()]
        try:
            x, feasible = _nearest(problem, x)
        except LinAlgError:
            return SolverResult(x, 0)
        if not feasible:
            return SolverResult(x, 0, True)
    programme = Programme(pattern, matrix)

    def step(x: Floats, values: Floats, gradient: Floats) -> tuple[Floats, float] | None:
        sides = constraint_rows(problem, x).sides if held else (np.empty(0), np.empty(0))
        try:
            return programme.solve(values, gradient, *sides) if system.cholesky.factor(values) else None
        except (LinAlgError, OSQPException, ValueError):  # what it cannot factorise
            return None

    end = arrive(system, x, min(1, max_iterations) if problem.linear else max_iterations, tolerance, step, held)
    return SolverResult(end.x, end.iterations, extras={"repairs": programme.repairs})


class Infeasible(LinAlgError):
    """No step satisfies the bounds."""


class Programme:
    """min 1/2 dx^T P dx + q^T dx within lower <= C dx <= upper: one workspace, whose values are updated.

    Args:
        pattern: the upper triangle of P (CSC), any values.
        rows: C.
    """

    def __init__(self, pattern: Any, rows: Any) -> None:
        self._pattern, self._rows = pattern, rows
        self._workspace: Any = None
        self._polishing = False
        self.repairs = 0

    def solve(self, values: Floats, q: Floats, lower: Floats, upper: Floats) -> tuple[Floats, float]:
        """dx for the values of the upper triangle of P, and y . C dx, the push of the bounds along it.

        Raises:
            Infeasible: no dx satisfies the bounds. numpy.linalg.LinAlgError: the KKT conditions stay unsatisfied.
        """
        import osqp

        if self._workspace is None:
            self._workspace, self._pattern.data = osqp.OSQP(), values
            self._workspace.setup(self._pattern, q, self._rows, lower, upper, rho=values.max(), **SETTINGS)
        else:
            self._polish(False)
            self._workspace.update(Px=values, q=q, l=lower, u=upper)
        for attempt in range(REPAIRS + 1):
            end = self._workspace.solve(raise_error=False)
            if end.info.status.startswith("primal infeasible"):
                raise Infeasible
            dx, y, value = np.array(end.x), np.array(end.y), self._rows @ end.x
            active = bool(np.any((upper - value < y) | (value - lower < -y)))
            if self._holds(values, q, lower, upper, dx, y) and self._polishing >= active:
                return dx, float(y @ value)
            self.repairs += attempt < REPAIRS and self._polishing >= active
            self._polish(active)
        raise LinAlgError("osqp: the KKT conditions of a quadratic programme stay unsatisfied")

    def _polish(self, wanted: bool) -> None:
        """Whether OSQP solves for its active set exactly; without one it would print a message."""
        if wanted != self._polishing:
            self._polishing = wanted
            self._workspace.update_settings(polishing=wanted)

    def _holds(self, values: Floats, q: Floats, lower: Floats, upper: Floats, dx: Floats, y: Floats) -> bool:
        """The KKT conditions, computed by ourselves: stationarity, bounds, and a push only where a bound is met."""
        own, value = values[self._pattern.indptr[1:] - 1], self._rows @ dx
        self._pattern.data = values
        rest = self._pattern @ dx + self._pattern.T @ dx - own * dx + q
        weak = KKT * float(np.maximum(abs(q), abs(own * dx)).max(initial=0.0))
        if not (abs(rest + self._rows.T @ y) <= weak + NEGLIGIBLE * own).all():
            return False
        met = np.where(y > weak, upper, np.where(y < -weak, lower, np.clip(value, lower, upper)))
        return bool((abs(value - met) <= BOUND_TOLERANCE).all())


def _nearest(problem: Problem, x: Floats) -> tuple[Floats, bool]:
    """x moved by the least step that satisfies the constraints and True; if there is none, by a step that violates them
    least, and False."""
    from scipy.sparse import csc_matrix, diags, eye, hstack

    rows = constraint_rows(problem, x)
    if not rows.outside.any():
        return x, True
    size = rows.matrix.shape[1]

    def least(weight: Floats, matrix: Any) -> Floats:
        return Programme(diags(weight, format="csc"), csc_matrix(matrix)).solve(weight, 0.0 * weight, *rows.sides)[0]

    try:
        step, feasible = least(np.ones(size), rows.matrix), True
    except Infeasible:
        slack = np.ones(len(rows.value))
        step = least(np.append(np.full(size, STEP_WEIGHT), slack), hstack([rows.matrix, eye(len(slack))]))
        feasible = False
    return problem.space.retract(x, step[:size].reshape(len(x), -1)), feasible


BACKEND = Backend("osqp", solver, "osqp", Capabilities(constraints="linear"))
