"""Whitened residuals of points in CasADi's expressions, from the formulas of their kinds."""

from typing import Any

import casadi as ca

from coopoc.optimize import MEASUREMENTS, Problem


def whitened(problem: Problem, x: Any) -> Any:
    """W (h - z) of all measurements, x (3, n)."""
    rows = []
    for factor in problem.factors:
        for k, nodes in enumerate(factor.nodes.tolist()):
            gap = x[:, nodes[-1]] - (x[:, nodes[0]] if len(nodes) == 2 else 0)
            h = ca.vertcat(*MEASUREMENTS[factor.kind].formula(gap[0], gap[1], gap[2], ca)) - factor.z[k]
            angles = factor.measurement.angles()
            h = [ca.atan2(ca.sin(h[c]), ca.cos(h[c])) if angle else h[c] for c, angle in enumerate(angles)]
            rows.append(ca.DM(factor.root[k]) @ ca.vertcat(*h))
    return ca.vertcat(*rows)
