"""gauss-newton: the reference. Levenberg-Marquardt, arrowhead elimination for stars and windows, sparse otherwise."""

from __future__ import annotations

from functools import partial

import numpy as np

from ...arrays import Floats
from ..assess import factorise
from ..curvature import newton_step
from ..dense import damped_step, is_small
from ..descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, descend, one_step
from ..linear import Linear
from ..problem import Problem
from .run import Ended, Run

PATIENCE = 40
"""Gauss-Newton steps before the exact Hessian takes over: with large residuals J^T J alone creeps or overshoots."""
DENSE_POINTS = 60
"""Up to this many points a problem without a hub is solved densely."""


def build(problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Run:
    """Solver of one problem.

    Args:
        max_iterations: of Gauss-Newton steps. tolerance: m, largest move of a point in the last step.
    """
    check_limits(max_iterations, tolerance)
    step = linear_step(problem)

    def run(x: Floats) -> Ended:
        if problem.linear and is_small(problem) and max_iterations:
            return Ended(one_step(problem, step, x[None])[0], 1)
        end = descend(problem, step, x[None], min(max_iterations, PATIENCE), tolerance)
        if end.converged[0] or max_iterations <= PATIENCE:
            return Ended(end.x[0], int(end.iterations[0]))
        more = descend(problem, partial(newton_step, problem), end.x, max_iterations - PATIENCE, tolerance)
        return Ended(more.x[0], int(end.iterations[0] + more.iterations[0]), {"newton_steps": int(more.iterations[0])})

    return run


def linear_step(problem: Problem) -> Step:
    """The linear solver that suits the structure; batched unless the problem is large and has no hub."""
    if not problem.hub and len(problem.names) > DENSE_POINTS:
        return partial(_sparse_step, problem)
    return partial(damped_step, problem)


def _sparse_step(problem: Problem, linear: Linear, damping: Floats) -> Floats:
    from scipy.sparse import diags_array

    out = np.empty_like(damping)
    still = None if problem.free is None else ~problem.free
    for b, residual in enumerate(zip(*linear.residual, strict=True)):
        J = problem.jacobian(linear, b)
        factored = factorise(J.T @ J + diags_array(damping[b].ravel()), still)
        out[b] = -factored.solve(J.T @ np.concatenate([r.ravel() for r in residual])).reshape(out[b].shape)
    return out
