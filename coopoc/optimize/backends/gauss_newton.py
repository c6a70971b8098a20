"""gauss-newton: the reference. Levenberg-Marquardt with sparse Cholesky factors; stars for all realisations at once."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats
from ..algebra.schur import is_star, star_at
from ..algebra.sparse import sparse
from ..backend import Backend, Capabilities, Solver, SolverResult
from ..descent.levenberg_marquardt import MAX_ITERATIONS, TOLERANCE, arrive, check_limits, minimise
from ..model.derivatives import Linear
from ..model.problem import Problem


def prepare(structure: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Solver:
    """Solver of a structure, for all realisations at once.

    Args:
        structure: a problem whose structure counts.
        max_iterations: of Gauss-Newton steps.
        tolerance: m, largest move of a point in the last step.
    """
    check_limits(max_iterations, tolerance)
    star = structure.batch is not None and is_star(structure)

    def step(linear: Linear, damping: Floats) -> Floats:
        return star_at(structure, linear).solve(damping)[0]

    def solver(problem: Problem, x: Floats) -> SolverResult:
        if problem.batch is None:
            end = arrive(sparse(problem), x[0], min(1, max_iterations) if problem.linear else max_iterations, tolerance)
            extras = {"newton_steps": end.newton_steps, "record": end.record}
            return SolverResult(end.x[None], np.array([end.iterations]), extras=extras)
        if star:
            return minimise(problem, step, x, max_iterations, tolerance)
        ends = [solver(single, start[None]) for single, start in zip(problem.realisations, x, strict=True)]
        return SolverResult(np.concatenate([e.x for e in ends]), np.concatenate([e.iterations for e in ends]))

    return solver


BACKEND = Backend(
    "gauss-newton",
    prepare,
    "reference: Levenberg-Marquardt, all realisations at once; large graphs by sparse Cholesky factors",
    library="casadi",  # writes the derivatives of all measurements
    capabilities=Capabilities(batched=True),
)
