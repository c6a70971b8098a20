"""gtsam: its native linear factors built once, the others as fresh JacobianFactors, its multifrontal elimination.

GTSAM has no factor for range, azimuth and inclination in the world frame with a std each: Pose3's bearing-range factor
weights the bearing's tangent plane equally, which is another objective, and a Python CustomFactor inside an optimiser
that C++ owns copies all Values at each callback. So the loop is owned here: the nonlinear factors are whitened and
linearised vectorised in NumPy and handed over as JacobianFactors, in absolute coordinates, so that the native ones
(PriorFactorPoint3, BetweenFactorPoint3) keep their linearisation over all steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats
from ..descend import MAX_ITERATIONS, TOLERANCE, descend
from ..factor import Factor
from ..linear import Linear
from ..problem import Problem
from .run import Ended, Run


def build(problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Run:
    """Solver of one problem.

    Args:
        max_iterations: of linear solves. tolerance: m, largest move of a point in the last step.
    """
    import gtsam

    space = problem.space
    fixed = native(problem).linearize(_zeros(problem))
    unit = {size: gtsam.noiseModel.Unit.Create(size) for size in range(1, 13)}
    ordering: list[Any] = []
    still = [] if problem.free is None else np.flatnonzero(~problem.free.all(axis=1)).tolist()

    def step(linear: Linear, damping: Floats) -> Floats:
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(fixed)
        at = linear.x[0] if not space.turning else np.zeros((len(problem.names), space.dof))
        _add_linearised(graph, problem, linear, at, unit)
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

    def run(x: Floats) -> Ended:
        end = descend(problem, step, x[None], max_iterations, tolerance)
        return Ended(end.x[0], int(end.iterations[0]))

    return run


def native(problem: Problem) -> Any:
    """gtsam.NonlinearFactorGraph of the factors that GTSAM has with exactly our objective and that are linear."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    if problem.space.turning:
        return graph
    plane = problem.dimension == 2
    prior = gtsam.PriorFactorPoint2 if plane else gtsam.PriorFactorPoint3
    between = gtsam.BetweenFactorPoint2 if plane else gtsam.BetweenFactorPoint3
    for factor in problem.factors:
        if not _is_native(problem, factor):
            continue
        for node, z, model in zip(factor.nodes.tolist(), factor.z, _models(factor), strict=True):
            if model is not None and len(node) == 1:
                graph.add(prior(node[0], z, model))
            elif model is not None:
                graph.add(between(node[0], node[1], z, model))
    return graph


def _is_native(problem: Problem, factor: Factor) -> bool:
    free = problem.free is None or bool(problem.free[factor.nodes].all())
    return factor.measurement.linear and factor.loss is None and free and not problem.space.turning


def _models(factor: Factor) -> list[Any]:
    """A noise model per measurement; None where it carries no information."""
    import gtsam

    if factor.std is not None and np.isfinite(factor.std).all():
        wide = np.broadcast_to(factor.std, factor.z.shape)
        distinct = {std: gtsam.noiseModel.Diagonal.Sigmas(np.array(std)) for std in set(map(tuple, wide))}
        return [distinct[tuple(std)] for std in wide]
    says = factor.informative
    return [gtsam.noiseModel.Gaussian.SqrtInformation(root, False) if informative else None
            for root, informative in zip(factor.root, says, strict=True)]  # fmt: skip


def _add_linearised(graph: Any, problem: Problem, linear: Linear, at: Floats, unit: dict[int, Any]) -> None:
    """The other factors as r + J dx with dx = x - `at`: GTSAM's unknowns are absolute where its own factors are."""
    derivatives = linear.by_node(problem.factors)
    for factor, residual, slopes in zip(problem.factors, linear.residual, derivatives, strict=True):
        if _is_native(problem, factor):
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


def _zeros(problem: Problem) -> Any:
    import gtsam

    values = gtsam.Values()
    for i in range(len(problem.names)):
        values.insert(i, np.zeros(problem.dimension))
    return values
