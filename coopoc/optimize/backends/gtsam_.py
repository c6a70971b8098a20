"""gtsam: its multifrontal elimination in a loop of ours, or its own optimisers on a graph of its own factors.

GTSAM has no factor for range, azimuth and inclination in the world frame with a std each, and a Python CustomFactor
inside an optimiser that C++ owns copies all Values at each callback. So the loop that takes every problem is owned
here: the nonlinear factors are whitened and linearised vectorised in NumPy and handed over as JacobianFactors, in
absolute coordinates, so that the native ones (PriorFactorPoint3, BetweenFactorPoint3) keep their linearisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..descend import MAX_ITERATIONS, TOLERANCE, Step, check_limits, descend
from ..factor import Factor
from ..linear import Linear
from ..problem import Problem
from .gtsam_forms import form_of, forms
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
        step = elimination_step(problem)

        def run(x: Floats) -> Ended:
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


def elimination_step(problem: Problem) -> Step:
    """GTSAM's multifrontal elimination, with an ordering (COLAMD) that is found once."""
    import gtsam

    space, own, n = problem.space, [_is_linear(problem, factor) for factor in problem.factors], len(problem.names)
    fixed = _constant(problem, own)
    unit = {size: gtsam.noiseModel.Unit.Create(size) for size in range(1, 13)}
    ordering: list[Any] = []
    still = [] if problem.free is None else np.flatnonzero(~problem.free.all(axis=1)).tolist()

    def step(linear: Linear, damping: Floats) -> Floats:
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(fixed)
        at = linear.x[0] if not space.turning else np.zeros((n, space.dof))
        _add_linearised(graph, problem, linear, at, own, unit)
        for i in still:
            graph.add(i, np.diag(1.0 - problem.free[i]), np.zeros(space.dof), unit[space.dof])  # type: ignore[index]
        if damping.any():
            for i, (x, root) in enumerate(zip(at, np.sqrt(damping[0]), strict=True)):
                graph.add(i, np.diag(root), root * x, unit[space.dof])
        if not ordering:
            ordering.append(gtsam.Ordering.ColamdGaussianFactorGraph(graph))
        try:
            there: Floats = graph.optimize(ordering[0]).vector()
        except RuntimeError as singular:
            raise np.linalg.LinAlgError("gtsam: indeterminate linear system") from singular
        if there.size < at.size:
            ordering.clear()
            raise np.linalg.LinAlgError("gtsam: a point without measurements")
        return (there.reshape(at.shape) - at)[None]

    return step


def _constant(problem: Problem, own: Sequence[bool]) -> Any:
    """gtsam.GaussianFactorGraph of GTSAM's own factors whose linearisation is the same everywhere."""
    said = [form_of(problem, factor) if mine else "" for factor, mine in zip(problem.factors, own, strict=True)]
    n = len(problem.names)
    nowhere = values(problem.space, [False] * n, np.zeros((n, problem.dimension)), range(n))
    return native_graph(problem, said).graph.linearize(nowhere)


def _is_linear(problem: Problem, factor: Factor) -> bool:
    """Whether GTSAM's own factor may be linearised once and for all."""
    free = problem.free is None or bool(problem.free[factor.nodes].all())
    return factor.measurement.linear and factor.loss is None and free and not problem.space.turning


def _add_linearised(
    graph: Any, problem: Problem, linear: Linear, at: Floats, own: Sequence[bool], unit: dict[int, Any]
) -> None:
    """The other factors as r + J dx with dx = x - `at`: GTSAM's unknowns are absolute where its own factors are."""
    derivatives = linear.by_node(problem.factors)
    for factor, residual, slopes, mine in zip(problem.factors, linear.residual, derivatives, own, strict=True):
        if mine:
            continue
        count, model = len(factor.nodes), unit[factor.size]
        parts = [np.broadcast_to(s[0], (count, *s.shape[2:])) for s in slopes]
        goal = -residual[0]
        for part, column in zip(parts, factor.nodes.T, strict=True):
            goal = goal + (part @ at[column, :, None])[..., 0]
        if len(parts) == 1:
            for i, a, rhs in zip(factor.nodes[:, 0].tolist(), parts[0], goal, strict=True):
                graph.add(i, a, rhs, model)
        else:
            for (i, j), a, b, rhs in zip(factor.nodes.tolist(), *parts, goal, strict=True):
                graph.add(i, a, j, b, rhs, model)
