"""osqp: sequential quadratic programming with one workspace per structure, whose values are updated at every step.

Settings matter (performance.md G4 of the design notes): OSQP says "solved" and can be a metre off when odometry weighs
5e5 times as much as GNSS. Scaling is off, over-relaxation is off (alpha = 1: without active constraints an iteration
is a proximal step with the weight sigma, and 1.6 would make 40 of them out of one), the tolerance is tight, and every
answer is held against its own KKT residual and repaired by further iterations where it fails.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats
from ..arrowhead import structure
from ..descend import MAX_ITERATIONS, TOLERANCE, descend
from ..linear import Linear
from ..normal import Pattern, normal_equations
from ..problem import Problem
from .run import Ended, Run

SETTINGS = {
    "scaling": 0, "rho": 1e-4, "alpha": 1.0, "sigma": 1e-6, "eps_abs": 1e-12, "eps_rel": 1e-12, "max_iter": 200,
    "check_termination": 1, "polishing": False, "adaptive_rho": 0, "warm_starting": True, "verbose": False,
}  # fmt: skip
NEGLIGIBLE = 1e-11
"""m, an error of a coordinate that no tolerance asks to be smaller."""
REPAIRS = 5
"""How often a quadratic programme is continued before its answer is refused."""


def build(
    problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE, kkt_tolerance: float = 1e-9
) -> Run:
    """Solver of one problem.

    Args:
        max_iterations: of quadratic programmes. tolerance: m, largest move of a point in the last step.
        kkt_tolerance: largest |P dx + q| that is accepted, as a share of |q| or of the largest |P_ij dx_j|.
    """
    import osqp

    scheme, _ = structure(problem)
    upper, source = _upper(scheme, problem.space.dof)
    size = problem.space.dof * scheme.nodes
    nodes, at_own = [f.nodes for f in problem.factors], np.arange(problem.space.dof)
    own = np.flatnonzero(scheme.pairs[:, 0] == scheme.pairs[:, 1])
    at = scheme.pairs[own, 0]
    solver: list[Any] = []
    counts = {"osqp_iterations": 0, "repairs": 0}

    def step(linear: Linear, damping: Floats) -> Floats:
        blocks, gradient = normal_equations(scheme, linear, nodes)
        if damping.any():
            blocks[:, own[:, None], at_own, at_own] += damping[:, at]
        upper.data[:] = blocks[0].ravel()[source]
        q = gradient.ravel()
        if not solver:
            solver.append(osqp.OSQP())
            solver[0].setup(P=upper.copy(), q=q, A=_no_rows(size), l=np.empty(0), u=np.empty(0), **SETTINGS)
        else:
            solver[0].update(Px=upper.data, q=q)
        return _checked(solver[0], upper, q, kkt_tolerance, counts).reshape(damping.shape)

    def run(x: Floats) -> Ended:
        end = descend(problem, step, x[None], max_iterations, tolerance)
        return Ended(end.x[0], int(end.iterations[0]), dict(counts))

    return run


def _checked(solver: Any, upper: Any, q: Floats, tolerance: float, counts: dict[str, int]) -> Floats:
    """The solution whose KKT residual |P dx + q| we have computed ourselves; LinAlgError if it stays too large."""
    weight = upper.diagonal()
    for attempt in range(REPAIRS + 1):
        answer = solver.solve(raise_error=False)
        counts["osqp_iterations"] += int(answer.info.iter)
        dx = np.asarray(answer.x, dtype=np.float64)
        force = upper @ dx + upper.T @ dx - weight * dx
        size = max(np.abs(q).max(), np.abs(weight * dx).max())
        if np.all(np.abs(force + q) <= tolerance * size + NEGLIGIBLE * weight):
            return dx
        if attempt < REPAIRS:
            counts["repairs"] += 1
    raise np.linalg.LinAlgError("osqp: the KKT residual of a quadratic programme stays too large")


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


def _no_rows(size: int) -> Any:
    from scipy.sparse import csc_matrix

    return csc_matrix((0, size))
