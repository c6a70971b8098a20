"""Whether a point that constraints hold is a minimum: the curvature of the Lagrangian along what remains free."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...arrays import Floats
from ..algebra.arrowhead import structure
from ..algebra.cholesky import cholesky_of
from ..model.constraint import Constraint, values
from ..model.local import chain, local
from ..model.problem import Problem
from ..model.space import Space
from .active import Active, constraint_rows
from .curvature import SLACK, STEP, is_minimum, matrix, true_blocks


def is_constrained_minimum(problem: Problem, x: Floats, active: Active) -> bool:
    """True unless the Lagrangian of a single problem curves downwards at x (n, ambient) within what `active` allows.

    Z^T (H + sum_c m_c d2 h_c / dx2) Z is positive definite, H the Hessian of the cost, m the multipliers and Z the
    directions that remain. The far side of a range that must be met is a stationary point too, and a maximum.
    Source: Nocedal and Wright, Numerical Optimization, 2nd ed., theorem 12.6.
    """
    from scipy.sparse import diags_array

    if problem.linear and all(c.measurement.linear for c in problem.constraints):
        return True
    if not active.holds:
        return is_minimum(replace(problem, constraints=()), x)
    J = problem.jacobian(linear := problem.linearise(x[None]))
    cost = matrix(structure(problem)[0], true_blocks(problem, linear))
    curved = cost + _constraint_curvature(problem, x, active.multipliers)
    curved = curved + SLACK * diags_array(np.asarray(J.multiply(J).sum(axis=0)).ravel())
    within = active.along.T @ curved @ active.along
    return not within.shape[0] or cholesky_of(within) is not None


def _constraint_curvature(problem: Problem, x: Floats, multipliers: Floats) -> Any:
    """(n dof, n dof) sparse sum of multipliers times second derivatives of the constraints."""
    from scipy.sparse import coo_array

    place, dof = constraint_rows(problem, x).place, problem.space.dof
    total = coo_array((len(problem.names) * dof,) * 2).tocsc()
    for k, item in enumerate(problem.constraints):
        own = place[:, 0] == k
        weight = np.zeros(item.lower.shape)
        weight[place[own, 1], place[own, 2]] = multipliers[own]
        pushing = np.flatnonzero(weight.any(axis=1))
        if item.measurement.linear or not len(pushing):
            continue
        nodes = item.nodes[pushing]
        free = np.ones((*nodes.shape, dof)) if problem.movable is None else problem.movable[nodes]
        free = free.reshape(len(nodes), -1)
        whole = _second(problem.space, item, pushing, x[nodes], weight[pushing]) * free[:, :, None] * free[:, None, :]
        at = (dof * nodes[:, :, None] + np.arange(dof)).reshape(len(nodes), -1)
        row, col = np.broadcast_arrays(at[:, :, None], at[:, None, :])
        total = total + coo_array((whole.ravel(), (row.ravel(), col.ravel())), shape=total.shape).tocsc()
    return total


def _second(space: Space, item: Constraint, rows: Any, at: Floats, weight: Floats) -> Floats:
    """(M, arity dof, arity dof) second derivative of weight . h, by central differences of the exact first.

    Args:
        item: a constraint, and which `rows` of it.
        at: (M, arity, ambient) nodes of each row.
        weight: (M, size).
    """
    count, arity = at.shape[:2]
    assert item.constants is not None
    alone = replace(
        item,
        nodes=np.arange(count * arity).reshape(count, arity),
        lower=item.lower[rows],
        upper=item.upper[rows],
        constants=item.constants[rows],
    )

    def jacobian(step: Floats) -> Floats:
        moved = space.retract(at, step.reshape(count, arity, space.dof)).reshape(1, count * arity, -1)
        seen = local(space, alone.measurement, moved, alone.nodes)
        value, inner = values(alone.measurement, alone, *seen)
        inner = np.broadcast_to(inner, (*value.shape, inner.shape[-1]))
        jacobians = chain(space, alone.measurement, moved, alone.nodes, seen, inner)
        jacobians = (-jacobians[0], jacobians[0]) if len(jacobians) < arity else jacobians
        pushing = (
            np.where(weight[..., None] != 0.0, s[0], 0.0) for s in jacobians
        )  # the others may have no derivative
        return np.concatenate([np.einsum("mk,mkd->md", weight, s) for s in pushing], axis=1)

    sides = STEP * np.eye(arity * space.dof)[:, None].repeat(count, axis=1)
    whole = np.stack([(jacobian(side) - jacobian(-side)) / (2.0 * STEP) for side in sides], axis=2)
    return 0.5 * (whole + np.swapaxes(whole, 1, 2))
