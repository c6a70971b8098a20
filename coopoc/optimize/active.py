"""Which constraints hold a point, how hard, and by how much any is violated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Bools, Floats
from .local import chain, local
from .problem import Problem

NEAR = 1e-6
"""m, rad or m/s: a constraint this close to its bound is active."""


@dataclass(frozen=True, eq=False)
class Rows:
    """All constraints of a problem at x, as rows of numbers.

    Args:
        value, lower, upper: (rows,). matrix: (rows, n dof) sparse derivative of the values.
    """

    value: Floats
    lower: Floats
    upper: Floats
    matrix: Any


@dataclass(frozen=True, eq=False)
class Active:
    """The constraints that hold at x.

    Args:
        matrix: (rows, n dof) sparse. gap: (rows,) value minus the bound it lies on. equality: (rows,).
        pull: (n dof,) C^T multipliers. violation: the largest of any constraint.
    """

    matrix: Any
    gap: Floats
    equality: Bools
    pull: Floats
    violation: float


def constraint_rows(problem: Problem, x: Floats) -> Rows:
    """The constraints of a single problem at x (n, width)."""
    from scipy.sparse import coo_array, vstack

    values, lowers, uppers, blocks = [], [], [], []
    space, n = problem.space, len(problem.names)
    for item in problem.constraints:
        known = item.measurement
        seen = local(space, known, x[None], item.nodes)
        assert item.constants is not None
        value, slope = known.differentiate(*seen, np.zeros(item.lower.shape), item.constants)
        slope = np.broadcast_to(slope, (*value.shape, slope.shape[-1]))
        slopes = chain(space, known, x[None], item.nodes, seen, slope)
        pair = item.nodes.shape[1] == 2
        slopes = (-slopes[0], slopes[0]) if pair and len(slopes) == 1 else slopes
        count, size = item.lower.shape
        row = np.arange(count * size).reshape(count, size, 1) + np.zeros(space.dof, np.int64)
        entries = [(s[0] if problem.free is None else s[0] * problem.free[c][:, None, :], c)
                   for s, c in zip(slopes, item.nodes.T, strict=True)]  # fmt: skip
        matrix = sum(
            coo_array((s.ravel(), (row.ravel(), (space.dof * c[:, None, None] + np.arange(space.dof)
                                                 + np.zeros((size, 1), np.int64)).ravel())),
                      shape=(count * size, n * space.dof)).tocsr() for s, c in entries)  # fmt: skip
        values.append(value[0].ravel())
        lowers.append(item.lower.ravel())
        uppers.append(item.upper.ravel())
        blocks.append(matrix)
    stacked = vstack(blocks, format="csr")
    return Rows(np.concatenate(values), np.concatenate(lowers), np.concatenate(uppers), stacked)


def active_at(problem: Problem, x: Floats, gradient: Floats) -> Active:
    """The constraints that hold at x (n, width), where the gradient of the cost is (n, dof).

    Multipliers are the least-squares ones with the signs that a minimum needs; what does not push is not active.
    """
    from scipy.optimize import lsq_linear

    rows = constraint_rows(problem, x)
    equal = rows.lower == rows.upper
    low, high = np.abs(rows.value - rows.lower) <= NEAR, np.abs(rows.value - rows.upper) <= NEAR
    outside = np.maximum(np.maximum(rows.lower - rows.value, rows.value - rows.upper), 0.0)
    touched = np.flatnonzero(equal | low | high)
    matrix = rows.matrix[touched]
    multipliers = np.zeros(0)
    if len(touched):
        floor = np.where(equal[touched] | low[touched], -np.inf, 0.0)
        roof = np.where(equal[touched] | high[touched], np.inf, 0.0)
        scale = np.maximum(np.abs(gradient).max(), 1e-12)
        tight = floor < roof
        multipliers = np.zeros(len(touched))
        found = lsq_linear(matrix[tight].T.toarray(), -gradient.ravel() / scale, (floor[tight], roof[tight]), tol=1e-14)
        multipliers[tight] = scale * found.x
    pushes = equal[touched] | (np.abs(multipliers) > 1e-9 * max(np.abs(multipliers).max(initial=0.0), 1e-300))
    bound = np.where(low[touched], rows.lower[touched], rows.upper[touched])
    return Active(
        matrix[pushes], (rows.value[touched] - bound)[pushes], equal[touched][pushes], matrix.T @ multipliers,
        float(outside.max(initial=0.0)),
    )  # fmt: skip
