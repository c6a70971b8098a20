"""gauss-newton: the reference. Levenberg-Marquardt, arrowhead elimination for stars and windows, sparse otherwise."""

from __future__ import annotations

from functools import partial

import numpy as np

from ...arrays import Floats
from ..algebra.cholesky import cholesky_of, with_still
from ..algebra.dense import damped_step
from ..assess.curvature import tapes
from ..backend import Backend, Capabilities, Solver, SolverResult
from ..descent.descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, descend
from ..descent.trust_region import arrive
from ..model.linear import Linear
from ..model.problem import Problem

DENSE_POINTS = 60
"""Up to this many points a problem without a separator is solved densely."""


def prepare(structure: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Solver:
    """Solver of a structure, for all realisations at once.

    Args:
        structure: a problem whose structure counts.
        max_iterations: of Gauss-Newton steps.
        tolerance: m, largest move of a point in the last step.
    """
    check_limits(max_iterations, tolerance)
    step = linear_step(structure)

    def solver(problem: Problem, x: Floats) -> SolverResult:
        if max_iterations and problem.batch is None and (system := tapes(problem)) is not None:
            found = arrive(system, x[0], 1 if problem.linear else max_iterations, tolerance)
            extras = {"newton_steps": found.newton_steps, "record": found.record}
            return SolverResult(found.x[None], np.array([found.iterations]), extras=extras)
        end = descend(problem, step, x, max_iterations, tolerance)
        return SolverResult(end.x, end.iterations, extras={"record": end.record})

    return solver


def linear_step(problem: Problem) -> Step:
    """The linear solver that suits the structure; batched unless the problem is large and has no separator."""
    if not problem.separator and len(problem.names) > DENSE_POINTS:
        return partial(_sparse_step, problem)
    return partial(damped_step, problem)


def _sparse_step(problem: Problem, linear: Linear, damping: Floats) -> Floats:
    out = np.empty_like(damping)
    still = None if problem.movable is None else ~problem.movable
    for b, residual in enumerate(zip(*linear.residual, strict=True)):
        J = problem.jacobian(linear, b)
        factored = cholesky_of(with_still(J.T @ J, damping[b] + (0 if still is None else still)))
        if factored is None:
            raise np.linalg.LinAlgError("J^T J is not positive definite")
        out[b] = -factored.solve(J.T @ np.concatenate([r.ravel() for r in residual])).reshape(out[b].shape)
    return out


BACKEND = Backend(
    "gauss-newton",
    prepare,
    "reference: Levenberg-Marquardt, all realisations at once; large graphs by sparse LU",
    capabilities=Capabilities(batched=True, compiled=True),
)
