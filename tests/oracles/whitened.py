"""Whitened residuals of points in expressions of CasADi, from the formulas of kinds, and the Hessian of their cost."""

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from coopoc.optimize import MEASUREMENTS, Problem

LOSSES = {
    "huber": lambda s, c: ca.if_else(s <= c**2, s, 2 * c * ca.sqrt(s) - c**2),
    "cauchy": lambda s, c: c**2 * ca.log(1 + s / c**2),
    "geman-mcclure": lambda s, c: s / (1 + s / c**2),
}
"""Of a squared residual and the scale."""


def whitened(problem: Problem, x: Any) -> Any:
    """W (h - z) of all measurements, x (3, n)."""
    return ca.vertcat(*(row for _, row in _rows(problem, x)))


def hessian(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Of the cost at x (n, 3)."""
    v, cost = ca.SX.sym("x", 3, len(problem.names)), 0
    for loss, row in _rows(problem, v):
        square = ca.sumsqr(row)
        cost += 0.5 * (LOSSES[loss.name](square, loss.scale) if loss else square)
    return np.asarray(ca.Function("H", [v], [ca.hessian(cost, ca.vec(v))[0]])(x.T))


def _rows(problem: Problem, x: Any) -> Iterator[tuple[Any, Any]]:
    for factor in problem.factors:
        for k, nodes in enumerate(factor.nodes.tolist()):
            gap = x[:, nodes[-1]] - (x[:, nodes[0]] if len(nodes) == 2 else 0)
            h = ca.vertcat(*MEASUREMENTS[factor.kind].formula(gap[0], gap[1], gap[2], ca)) - factor.z[k]
            angles = factor.measurement.angles()
            h = [ca.atan2(ca.sin(h[c]), ca.cos(h[c])) if angle else h[c] for c, angle in enumerate(angles)]
            yield factor.loss, ca.DM(factor.root[k]) @ ca.vertcat(*h)
