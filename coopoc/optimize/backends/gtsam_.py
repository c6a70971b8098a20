"""gtsam: its multifrontal elimination in a loop of ours, or its own optimisers on a graph of its own factors.

GTSAM has no factor for range, azimuth and inclination in the world frame with a std each, and a Python CustomFactor
inside an optimiser that C++ owns copies all Values at each callback. So the loop that takes every problem is owned
here: factors are whitened and linearised in NumPy, all realisations at once, and handed over as JacobianFactors, which
costs less than GTSAM's own and their noise models.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, descend, one_step
from ..linear import Linear
from ..problem import Problem
from .gtsam_forms import forms
from .gtsam_native import estimate, hold, native_graph, values, which_turn
from .gtsam_optimizers import OPTIMIZERS, all_native, graduation, levenberg_marquardt
from .run import Ended, Run


def build(
    problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE, optimizer: str = "elimination"
) -> Run:
    """Solver of one problem.

    Args:
        max_iterations: of linear solves. tolerance: m or rad, largest move of a node in the last step.
        optimizer: "elimination" is Levenberg-Marquardt of ours with GTSAM's elimination, for every problem. "lm",
            "dogleg" and "isam2" are GTSAM's own, for problems of its own factors only; the last step is "lm"'s, since
            GTSAM's dogleg ends at a trust region of 1e-5. So is "gnc", graduated non-convexity for losses "truncated"
            or "geman-mcclure" of one scale: it needs no good start to tell who is wrong; what has no loss is believed,
            and extras["weights"] has (M,) weights of each factor's measurements.

    Raises:
        InputError: an unknown optimizer, factors that it does not have (they are named).
    """
    check_limits(max_iterations, tolerance)
    if optimizer == "elimination":
        step = linear_step(problem)

        def run(x: Floats) -> Ended:
            if problem.linear and max_iterations:
                return Ended(one_step(problem, step, x[None])[0], 1)
            end = descend(problem, step, x[None], max_iterations, tolerance)
            return Ended(end.x[0], int(end.iterations[0]))

        return run
    if optimizer not in OPTIMIZERS:
        known = ["elimination", *OPTIMIZERS]
        raise InputError("optimizer", repr(optimizer), f"must be one of {known}", "Leave it out for elimination.")
    return _optimising(problem, max_iterations, tolerance, optimizer)


def _optimising(problem: Problem, max_iterations: int, tolerance: float, optimizer: str) -> Run:
    said, posed, space = forms(problem), which_turn(problem), problem.space
    all_native(problem, said, optimizer)
    graph, keys = native_graph(problem, said).graph, range(len(problem.names))
    hold(problem, graph)
    graduate = graduation(problem, said) if optimizer == "gnc" else None

    def run(x: Floats) -> Ended:
        at, before, count = values(space, posed, x, keys), 0, 0
        extras: dict[str, Any] = {}
        advance = OPTIMIZERS[optimizer]
        try:
            if graduate is not None:
                at, before, extras["weights"] = graduate(at, max_iterations)
                x = estimate(space, posed, at, keys)
            while count < max_iterations:
                at, used = advance(graph, at, max_iterations - count)
                last, x, count = x, estimate(space, posed, at, keys), count + used
                if advance is levenberg_marquardt and np.abs(x - last).max(initial=0.0) <= tolerance:
                    break
                advance = levenberg_marquardt
        except RuntimeError:  # a singular system: `solve` says which nodes are free
            pass
        return Ended(x, before + count, extras)

    return run


def linear_step(problem: Problem) -> Step:
    """GTSAM's multifrontal elimination, one realisation after the other, with an ordering (COLAMD) per structure."""
    import gtsam

    unit, nothing = _units(), np.zeros(problem.space.dof)
    own = unit[problem.space.dof]
    held = [] if problem.free is None else [(i, np.diag(1.0 - problem.free[i]))
                                            for i in np.flatnonzero(~problem.free.all(axis=1)).tolist()]  # fmt: skip
    touched = tuple((f.nodes.shape[1], f.nodes.tobytes()) for f in problem.factors)
    orderings = _orderings(touched, tuple(i for i, _ in held))

    def step(linear: Linear, damping: Floats) -> Floats:
        dx, rows = np.full_like(damping, np.nan), _rows(problem, linear)
        damped = [bool(each.any()) for each in damping]
        for b in range(len(dx)):
            graph = gtsam.GaussianFactorGraph()
            _add(graph, rows, b, unit)
            for i, root in (*held, *(enumerate(map(np.diag, np.sqrt(damping[b]))) if damped[b] else ())):
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
def _orderings(factors: tuple[tuple[int, bytes], ...], held: tuple[int, ...]) -> dict[bool, Any]:
    """Of the graphs of a structure, without and with damping, as they are found."""
    return {}


def _rows(problem: Problem, linear: Linear) -> list[tuple[list[list[int]], list[Floats], Floats]]:
    """Per factor the nodes by place (arity, M), a derivative (B, M, size, dof) by each of them, and -r (B, M, size).

    The derivatives are read-only: GTSAM's wrapper takes those a tenth faster.
    """
    found = []
    for factor, residual, slopes in zip(problem.factors, linear.residual, linear.by_node(problem.factors), strict=True):
        wide = [np.broadcast_to(slope, (*residual.shape, slope.shape[-1])) for slope in slopes]
        found.append((factor.nodes.T.tolist(), wide, -residual))
    return found


def _add(graph: Any, rows: list[tuple[list[list[int]], list[Floats], Floats]], b: int, unit: dict[int, Any]) -> None:
    """Realisation b of the rows as JacobianFactors."""
    for nodes, slopes, goal in rows:
        model = unit[goal.shape[-1]]
        if len(nodes) == 1:
            for i, slope, rhs in zip(nodes[0], slopes[0][b], goal[b], strict=True):
                graph.add(i, slope, rhs, model)
        else:
            for i, first, j, second, rhs in zip(nodes[0], slopes[0][b], nodes[1], slopes[1][b], goal[b], strict=True):
                graph.add(i, first, j, second, rhs, model)
