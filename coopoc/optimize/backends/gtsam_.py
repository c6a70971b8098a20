"""gtsam: its own optimisers on a graph of its own factors, or its multifrontal elimination in a loop of ours.

GTSAM has no factor for range, azimuth and inclination in the world frame with a std each, and a Python CustomFactor
inside an optimiser that C++ owns copies all Values at each callback. So the loop that takes every problem is owned
here: factors are whitened and linearised in NumPy, all realisations at once, and handed over as JacobianFactors, which
costs less than GTSAM's own and their noise models.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats
from ...plugins import one_of
from ..algebra.sparse import sparse
from ..backend import Backend, Capabilities, Options, Solver, SolverResult, looped
from ..descent.descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, minimise
from ..descent.trust_region import arrive
from ..model.linear import Linear
from ..model.problem import Problem
from .gtsam_forms import forms
from .gtsam_native import estimate, fix_nodes, native_graph, values, which_turn
from .gtsam_optimizers import OPTIMIZERS, all_native, as_it_comes, gnc, levenberg_marquardt

PATIENCE = 12
"""Steps of the elimination after GTSAM's own optimiser before the exact Hessian takes over."""


def prepare(
    structure: Problem,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
    optimizer: str = "auto",
) -> Solver:
    """Solver of a structure.

    Args:
        structure: a problem whose structure counts.
        max_iterations: of linear solves.
        tolerance: m or rad, largest move of a node in the last step.
        optimizer: "lm" is GTSAM's own Levenberg-Marquardt on its own factors, for problems that have no others, to the
            last digit. "elimination" is our loop with GTSAM's elimination, for every problem. "auto" is GTSAM's own
            with its own settings where it has every factor, and then "elimination" for the last digits; where its
            J^T J creeps, as with large residuals, the last steps are those of the exact Hessian, which GTSAM does not
            have (extras["newton_steps"]). Linear problems, which are one elimination, and realisations are left to
            that. "gnc" is its graduated
            non-convexity for losses "truncated" or "geman-mcclure" of one scale, then "lm": it needs no good start to
            find the outliers; a factor without a loss is a known inlier, and extras["weights"] has the weights (M,) of
            each factor's measurements.

    Raises:
        InputError: an unknown optimizer, factors that GTSAM lacks (they are named).
    """
    check_limits(max_iterations, tolerance)
    one_of("optimizer", optimizer, OPTIMIZERS)
    if optimizer in ("auto", "elimination"):
        step, own = linear_step(structure), optimizer == "auto" and _own(structure)

        def solver(problem: Problem, x: Floats) -> SolverResult:
            used = 0
            if own and max_iterations:
                x, used = _own_way(problem, x, max_iterations)
            left = max_iterations - used
            patient = optimizer == "elimination" or left <= PATIENCE
            system = None if patient else sparse(problem)
            end = minimise(problem, step, x, left if system is None else PATIENCE, tolerance)
            if system is not None and int(np.max(end.iterations)) >= PATIENCE:
                more = arrive(system, end.x[0], left - PATIENCE, tolerance)
                extras = end.extras | {"newton_steps": more.newton_steps}
                end = replace(end, x=more.x[None], iterations=end.iterations + more.iterations, extras=extras)
            method = {"method": "lm", "lm_iterations": used} if own else {"method": "elimination"}
            return replace(end, iterations=end.iterations + used, extras=end.extras | method)

        return solver
    return looped(lambda problem, x: _optimised(problem, x, max_iterations, tolerance, optimizer))


def fallback(problem: Problem, options: Options) -> Options | None:
    """Our loop with GTSAM's elimination, where GTSAM's own Levenberg-Marquardt did not arrive."""
    if options.get("optimizer", "auto") != "auto" or not _own(problem):
        return None
    return {**options, "optimizer": "elimination"}


def _own(problem: Problem) -> bool:
    """Whether GTSAM has every factor of a single problem that is not linear."""
    if problem.linear or problem.batch is not None:
        return False
    return not any(isinstance(form, str) for form in forms(problem))


def _own_way(problem: Problem, x: Floats, limit: int) -> tuple[Floats, int]:
    """Where GTSAM's own optimiser comes from x (1, n, ambient), and its iterations; x where it does not start."""
    posed, keys = which_turn(problem), range(len(problem.names))
    graph = native_graph(problem, forms(problem)).graph
    fix_nodes(problem, graph)
    try:
        at, used = as_it_comes(graph, values(problem.space, posed, x[0], keys), limit)
    except RuntimeError:  # a singular system: `solve` names the nodes that are free
        return x, 0
    return estimate(problem.space, posed, at, keys)[None], used


def _optimised(problem: Problem, x: Floats, max_iterations: int, tolerance: float, optimizer: str) -> SolverResult:
    """The result of GTSAM's own optimiser from x (n, ambient)."""
    forms_, posed, space = forms(problem), which_turn(problem), problem.space
    all_native(problem, forms_, optimizer)
    graph, keys = native_graph(problem, forms_).graph, range(len(problem.names))
    fix_nodes(problem, graph)
    at, before, count = values(space, posed, x, keys), 0, 0
    extras: dict[str, Any] = {}
    try:
        if optimizer == "gnc":
            at, before, extras["weights"] = gnc(problem, forms_)(at, max_iterations)
            x = estimate(space, posed, at, keys)
        while count < max_iterations:
            at, used = levenberg_marquardt(graph, at, max_iterations - count)
            last, x, count = x, estimate(space, posed, at, keys), count + used
            if np.abs(x - last).max(initial=0.0) <= tolerance:
                break
    except RuntimeError:  # a singular system: `solve` names the nodes that are free
        pass
    return SolverResult(x, before + count, extras=extras)


def linear_step(problem: Problem) -> Step:
    """GTSAM's multifrontal elimination, one realisation after the other, with an ordering (COLAMD) per structure."""
    import gtsam

    unit, nothing = _units(), np.zeros(problem.space.dof)
    own = unit[problem.space.dof]
    fixed = (
        []
        if problem.movable is None
        else [(i, np.diag(1.0 - problem.movable[i])) for i in np.flatnonzero(~problem.movable.all(axis=1)).tolist()]
    )
    touched = tuple((f.nodes.shape[1], f.nodes.tobytes()) for f in problem.factors)
    orderings = _orderings(touched, tuple(i for i, _ in fixed))

    def step(linear: Linear, damping: Floats) -> Floats:
        dx, rows = np.full_like(damping, np.nan), _rows(problem, linear)
        damped = [bool(each.any()) for each in damping]
        for b in range(len(dx)):
            graph = gtsam.GaussianFactorGraph()
            _add(graph, rows, b, unit)
            for i, root in (*fixed, *(enumerate(map(np.diag, np.sqrt(damping[b]))) if damped[b] else ())):
                graph.add(i, root, nothing, own)
            if damped[b] not in orderings:  # what is damped has every node, even one without measurements
                orderings[damped[b]] = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
            try:
                there: Floats = graph.optimize(orderings[damped[b]]).vector()
            except RuntimeError:  # a singular system: the step is not finite
                continue
            if there.size == dx[b].size:
                dx[b] = there.reshape(dx[b].shape)
        return dx

    return step


@lru_cache(maxsize=1)
def _units() -> dict[int, Any]:
    """GTSAM's noise models of variance one by size."""
    import gtsam

    return {size: gtsam.noiseModel.Unit.Create(size) for size in range(1, 13)}


@lru_cache(maxsize=256)
def _orderings(factors: tuple[tuple[int, bytes], ...], fixed: tuple[int, ...]) -> dict[bool, Any]:
    """Of the graphs of a structure, without and with damping, as they are found."""
    return {}


def _rows(problem: Problem, linear: Linear) -> list[tuple[list[list[int]], list[Floats], Floats]]:
    """Per factor the nodes by place (arity, M), a derivative (B, M, size, dof) by each of them, and -r (B, M, size).

    The derivatives are read-only: GTSAM's wrapper takes those a tenth faster.
    """
    found = []
    for factor, residual, jacobians in zip(
        problem.factors, linear.residual, linear.by_node(problem.factors), strict=True
    ):
        wide = [np.broadcast_to(jacobian, (*residual.shape, jacobian.shape[-1])) for jacobian in jacobians]
        found.append((factor.nodes.T.tolist(), wide, -residual))
    return found


def _add(graph: Any, rows: list[tuple[list[list[int]], list[Floats], Floats]], b: int, unit: dict[int, Any]) -> None:
    """Realisation b of the rows as JacobianFactors."""
    for nodes, jacobians, goal in rows:
        model = unit[goal.shape[-1]]
        if len(nodes) == 1:
            for i, jacobian, rhs in zip(nodes[0], jacobians[0][b], goal[b], strict=True):
                graph.add(i, jacobian, rhs, model)
        else:
            for i, first, j, second, rhs in zip(
                nodes[0], jacobians[0][b], nodes[1], jacobians[1][b], goal[b], strict=True
            ):
                graph.add(i, first, j, second, rhs, model)


BACKEND = Backend(
    "gtsam",
    prepare,
    "GTSAM's own factors and Levenberg-Marquardt where it has them all, else its elimination; GNC (optimizer=)",
    "gtsam",
    Capabilities(batched=True),
    fallback,
)
