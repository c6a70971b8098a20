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
from ..problem import Linear, Problem
from .run import Ended, Run


def build(problem: Problem, max_iterations: int = MAX_ITERATIONS, tolerance: float = TOLERANCE) -> Run:
    """Solver of one problem.

    Args:
        max_iterations: of linear solves. tolerance: m, largest move of a point in the last step.
    """
    import gtsam

    fixed = native(problem).linearize(_zeros(len(problem.names)))
    unit = {size: gtsam.noiseModel.Unit.Create(size) for size in (1, 2, 3)}
    ordering: list[Any] = []

    def step(linear: Linear, damping: Floats) -> Floats:
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(fixed)
        _add_linearised(graph, problem, linear, unit)
        if damping.any():
            for i, (x, root) in enumerate(zip(linear.x[0], np.sqrt(damping[0]), strict=True)):
                graph.add(i, np.diag(root), root * x, unit[3])
        if not ordering:
            ordering.append(gtsam.Ordering.ColamdGaussianFactorGraph(graph))
        try:
            there: Floats = graph.optimize(ordering[0]).vector()
        except RuntimeError as singular:
            raise np.linalg.LinAlgError("gtsam: indeterminate linear system") from singular
        if there.size < linear.x.size:
            ordering.clear()
            raise np.linalg.LinAlgError("gtsam: a point without measurements")
        return there.reshape(linear.x.shape) - linear.x

    def run(x: Floats) -> Ended:
        end = descend(problem, step, x[None], max_iterations, tolerance)
        return Ended(end.x[0], int(end.iterations[0]))

    return run


def native(problem: Problem) -> Any:
    """gtsam.NonlinearFactorGraph of the factors that GTSAM has with exactly our objective and that are linear."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for factor in problem.factors:
        if not factor.measurement.linear:
            continue
        for node, z, model in zip(factor.nodes.tolist(), factor.z, _models(factor), strict=True):
            if model is not None and len(node) == 1:
                graph.add(gtsam.PriorFactorPoint3(node[0], z, model))
            elif model is not None:
                graph.add(gtsam.BetweenFactorPoint3(node[0], node[1], z, model))
    return graph


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


def _add_linearised(graph: Any, problem: Problem, linear: Linear, unit: dict[int, Any]) -> None:
    for factor, residual, slope in zip(problem.factors, linear.residual, linear.slope, strict=True):
        known = factor.measurement
        if known.linear:
            continue
        first, second = factor.nodes.T
        gap = linear.x[0, second] - linear.x[0, first]
        goal = (slope[0] @ gap[..., None])[..., 0] - residual[0]
        model = unit[known.size]
        for i, j, a, b, rhs in zip(first.tolist(), second.tolist(), -slope[0], slope[0], goal, strict=True):
            graph.add(i, a, j, b, rhs, model)


def _zeros(points: int) -> Any:
    import gtsam

    values = gtsam.Values()
    for i in range(points):
        values.insert(i, np.zeros(3))
    return values
