"""Whether a point is a minimum: the exact Hessian, of the Lagrangian where constraints hold, and a Newton step's
promise."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ..algebra.cholesky import cholesky_of, with_still
from ..algebra.sparse import sparse
from ..model.factor import Factor, as_factor, unchecked
from ..model.linear import linearise
from ..model.parts import taken
from ..model.problem import Problem
from .active import Active, constraint_rows

STEP = 1e-4
"""rad, m, or share of a pair's distance: the second derivative of a constraint is a central difference of the exact
first."""
SLACK = 1e-6
"""Share of the diagonal of J^T J by which the curvature may be negative: a flat minimum is one, whatever the
rounding."""


def is_minimum(problem: Problem, x: Floats) -> bool:
    """True unless the cost of a single problem curves downwards at x (n, ambient), where its gradient vanishes.

    The Hessian is J^T J + sum_k r_k d2 r_k / dx2. J^T J alone is positive definite at a saddle too, such as an ego on
    the line between two others whose ranges are longer than the line. Where there are constraints see
    `is_constrained_minimum`.
    """
    return newton_decrease(problem, x) is not None


def newton_decrease(problem: Problem, x: Floats) -> float | None:
    """By how much a full Newton step from x (n, ambient) promises to lower the cost, 1/2 g^T H^-1 g; None if it curves
    downwards there.

    It is half the squared Newton decrement, the distance to the minimum in standard deviations, whatever the units of
    the nodes (Boyd and Vandenberghe, Convex Optimization, section 9.5.1). A linear problem has J^T J alone and promises
    nothing more here.
    """
    if problem.linear or problem.constraints:
        return 0.0
    system = sparse(problem)
    _, gradient, values = system.quadratic(x, "newton")
    if not np.isfinite(values).all():
        return None
    if not system.cholesky.factor(values):
        own = system.entries.diagonal
        values[own] += SLACK * system.quadratic(x, "gauss-newton")[2][own]
        if not system.cholesky.factor(values):
            return None
    return float(0.5 * gradient @ system.cholesky.solve(gradient))


def is_constrained_minimum(problem: Problem, x: Floats, active: Active) -> bool:
    """True unless the Lagrangian of a single problem curves downwards at x (n, ambient) within what `active` allows.

    Z^T (H + sum_c m_c d2 h_c / dx2) Z is positive definite, H the Hessian of the cost, m the multipliers and Z the
    directions that remain. The far side of a range that must be met is a stationary point too, and a maximum.
    Source: Nocedal and Wright, Numerical Optimization, 2nd ed., theorem 12.6.
    """
    if problem.linear and all(c.measurement.linear for c in problem.constraints):
        return True
    if not active.holds:
        return is_minimum(problem.replace_unchecked(constraints=()), x)
    J = problem.whiten(x)[1]
    curved = with_still(hessian(problem, x), SLACK * J.power(2).sum(axis=0))
    place = constraint_rows(problem, x).place
    for k, item in enumerate(problem.constraints):
        own, weight = place[:, 0] == k, np.zeros(item.lower.shape)
        weight[place[own, 1], place[own, 2]] = active.multipliers[own]
        rows = np.flatnonzero(weight.any(axis=1))
        if len(rows) and not item.measurement.linear:
            second = _second(problem, taken(as_factor(item), rows), x[item.nodes[rows]], weight[rows])
            curved = curved + _assembled(problem, item.nodes[rows], second)
    within = active.along.T @ curved @ active.along
    return not within.shape[0] or cholesky_of(within) is not None


def hessian(problem: Problem, x: Floats) -> Any:
    """(n dof, n dof) sparse exact Hessian of the cost of a single problem at x (n, ambient), 1 for what cannot move."""
    from scipy.sparse import csc_array, csr_array, triu

    size, system = len(problem.names) * problem.space.dof, sparse(problem)
    still = None if problem.movable is None else ~problem.movable
    upper = system.quadratic(x, "newton")[2], system.entries.indices, system.entries.indptr
    half = csc_array(upper, shape=(system.size,) * 2)
    moving = np.flatnonzero(system.entries.number.ravel() >= 0)
    into = csr_array((np.ones(system.size), (moving, np.arange(system.size))), shape=(size, system.size))
    return with_still(into @ (half + triu(half, 1).T) @ into.T, still)


def _second(problem: Problem, factor: Factor, at: Floats, weight: Floats) -> Floats:
    """(M, arity dof, arity dof) second derivative of weight . h by the steps of each measurement's nodes.

    Every measurement gets nodes of its own, so that one call moves them all.

    Args:
        factor: whose residual is h.
        at: (M, arity, ambient) nodes.
        weight: (M, size).
    """
    space, (count, arity) = problem.space, at.shape[:2]
    apart = unchecked(factor, nodes=np.arange(count * arity).reshape(count, arity))
    gap = np.linalg.norm(space.position(at[:, -1] - at[:, 0]), axis=-1) if arity > 1 else np.ones(count)
    reach = np.where(np.arange(space.dof)[:, None] < problem.dimension, STEP * np.maximum(gap, 1e-3), STEP)

    def gradient(step: Floats) -> Floats:
        moved = space.retract(at, step).reshape(1, count * arity, -1)
        (jacobians,) = linearise(space, [apart], None, moved).jacobian
        # what has no weight may have no derivative
        kept = (np.where(weight[..., None] != 0.0, jacobian[0], 0.0) for jacobian in jacobians)
        return np.concatenate([np.einsum("mk,mkd->md", weight, jacobian) for jacobian in kept], axis=1)

    columns = []
    for moved in range(arity):
        for c in range(space.dof):
            step = np.zeros((count, arity, space.dof))
            step[:, moved, c] = reach[c]
            with np.errstate(all="ignore"):
                columns.append((gradient(step) - gradient(-step)) / (2.0 * reach[c][:, None]))
    whole = np.stack(columns, axis=2)
    return np.asarray(0.5 * (whole + np.swapaxes(whole, 1, 2)))


def _assembled(problem: Problem, nodes: Ints, blocks: Floats) -> Any:
    """(n dof, n dof) sparse sum of blocks (M, arity dof, arity dof) of nodes (M, arity), without what cannot move."""
    from scipy.sparse import coo_array

    dof = problem.space.dof
    at = (dof * nodes[:, :, None] + np.arange(dof)).reshape(len(nodes), -1)
    if problem.movable is not None:
        moves = problem.movable.ravel()[at]
        blocks = blocks * (moves[:, :, None] & moves[:, None, :])
    row, col = np.broadcast_arrays(at[:, :, None], at[:, None, :])
    return coo_array((blocks.ravel(), (row.ravel(), col.ravel())), shape=(len(problem.names) * dof,) * 2).tocsc()
