"""gtsam: its own Levenberg-Marquardt on a graph of its own factors, or its multifrontal elimination in a loop of ours.

GTSAM has no factor for range, azimuth and inclination in the world frame with a std each, and a Python CustomFactor
inside an optimiser that C++ owns copies all Values at each callback. So the loop that takes every problem is owned
here: factors are whitened and linearised in NumPy, all realisations at once, and handed over as JacobianFactors, which
costs less than GTSAM's own and their noise models.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...arrays import Floats
from ..algebra.sparse import sparse
from ..backend import Backend, Capabilities, Solver, SolverResult
from ..descent.levenberg_marquardt import MAX_ITERATIONS, TOLERANCE, Step, arrive, check_limits, minimise
from ..model.derivatives import Linear
from ..model.problem import Problem
from .gtsam_factors import estimate, forms, graph_of, values, which_turn

MOST = 100
"""Iterations of GTSAM's own optimiser, its default."""
PATIENCE = 12
"""Eliminations before the exact Hessian takes over."""


def prepare(structure: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Solver:
    """Solver of a structure.

    GTSAM's own Levenberg-Marquardt goes first where it has every factor of a single problem that is not linear; then,
    and for every other problem, our loop with GTSAM's elimination. Where that creeps, as with large residuals, the last
    steps are those of the exact Hessian, which GTSAM does not have (extras["newton_steps"]).

    Args:
        structure: a problem whose structure counts.
        max_iterations: of linear solves.
        tolerance: m or rad, largest move of a node in the last step.
    """
    check_limits(max_iterations, tolerance)
    step, own = linear_step(structure), not structure.linear and structure.batch is None
    own = own and not any(isinstance(form, str) for form in forms(structure))

    def solver(problem: Problem, x: Floats) -> SolverResult:
        used = 0
        if own and max_iterations:
            x, used = levenberg_marquardt(problem, x, min(max_iterations, MOST))
        left = max_iterations - used
        patience = left if problem.batch is not None else min(left, PATIENCE)
        end = minimise(problem, step, x, patience, tolerance)
        if problem.batch is None and int(np.max(end.iterations)) >= PATIENCE:
            more = arrive(sparse(problem), end.x[0], left - patience, tolerance)
            extras = end.extras | {"newton_steps": more.newton_steps}
            end = replace(end, x=more.x[None], iterations=end.iterations + more.iterations, extras=extras)
        method = {"method": "lm", "lm_iterations": used} if own else {"method": "elimination"}
        return replace(end, iterations=end.iterations + used, extras=end.extras | method)

    return solver


def levenberg_marquardt(problem: Problem, x: Floats, limit: int) -> tuple[Floats, int]:
    """Where GTSAM's own optimiser comes from x (1, n, ambient), and its iterations; x where it does not start.

    With its own settings it stops where the cost falls by less than 1e-5 of it.
    """
    import gtsam

    posed, keys, params = which_turn(problem), range(len(problem.names)), gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(limit)
    start = values(problem.space, posed, x[0], keys)
    found = gtsam.LevenbergMarquardtOptimizer(graph_of(problem, forms(problem)), start, params)
    try:
        return estimate(problem.space, posed, found.optimize(), keys)[None], found.iterations()
    except RuntimeError:  # a singular system: `solve` names the nodes that are free
        return x, 0


def linear_step(problem: Problem) -> Step:
    """GTSAM's multifrontal elimination, one realisation after the other, with an ordering (COLAMD) that is kept."""
    import gtsam

    unit = {size: gtsam.noiseModel.Unit.Create(size) for size in range(1, 13)}
    nothing, orderings = np.zeros(problem.space.dof), dict[bool, Any]()
    still = np.zeros((len(problem.names), problem.space.dof)) if problem.movable is None else 1.0 - problem.movable

    def step(linear: Linear, damping: Floats) -> Floats:
        dx, rows = np.full_like(damping, np.nan), _rows(problem, linear)
        added: Floats = np.sqrt(damping + still)
        for b, touched in enumerate(np.any(added != 0.0, axis=2).tolist()):
            graph: Any = gtsam.GaussianFactorGraph()
            for nodes, jacobians, goal in rows:
                model = unit[goal.shape[-1]]
                columns = [part for at, by in zip(nodes, jacobians, strict=True) for part in (at, by[b])]
                for row in zip(*columns, goal[b], strict=True):
                    graph.add(*row, model)
            for i in np.flatnonzero(touched).tolist():
                graph.add(i, np.diag(added[b, i]), nothing, unit[len(nothing)])
            damped = bool(damping[b].any())
            if damped not in orderings:  # what is damped has every node, even one without measurements
                orderings[damped] = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
            try:
                there: Floats = graph.optimize(orderings[damped]).vector()
            except RuntimeError:  # a singular system: the step is not finite
                continue
            if there.size == dx[b].size:
                dx[b] = there.reshape(dx[b].shape)
        return dx

    return step


def _rows(problem: Problem, linear: Linear) -> list[tuple[list[list[int]], list[Floats], Floats]]:
    """Per factor the nodes (arity, M), a derivative (B, M, size, dof) by each of them, and -r (B, M, size).

    The derivatives are read-only: GTSAM's wrapper takes those a tenth faster.
    """
    found = []
    for factor, residual, jacobians in zip(problem.factors, linear.residual, linear.jacobian, strict=True):
        wide = [np.broadcast_to(jacobian, (*residual.shape, jacobian.shape[-1])) for jacobian in jacobians]
        found.append((factor.nodes.T.tolist(), wide, -residual))
    return found


BACKEND = Backend(
    "gtsam",
    prepare,
    "GTSAM's own factors and Levenberg-Marquardt where it has them all, else its elimination",
    "gtsam",
    Capabilities(batched=True),
)
