"""Whether a point is a minimum: the curvature that Gauss-Newton leaves out, and what a Newton step still promises."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ..algebra.arrowhead import structure
from ..algebra.cholesky import cholesky_of
from ..algebra.normal import Pattern, assemble, normal_equations
from ..algebra.sparse import Sparse, sparse
from ..model.factor import Factor, unchecked
from ..model.linear import Linear, linearise, opposite
from ..model.problem import Problem

STEP = 1e-4
"""Of the vector's length: the second derivative is a central difference of the exact first."""
SMALL = 60
"""Nodes up to which a dense factorisation is faster."""
SLACK = 1e-6
"""Share of the diagonal by which the curvature may be negative: a flat minimum is one, whatever the rounding."""


def is_minimum(problem: Problem, x: Floats) -> bool:
    """True unless the cost of a single problem curves downwards at x (n, ambient), where its gradient vanishes.

    The Hessian is J^T J + sum_k r_k d2 r_k / dx2. J^T J alone is positive definite at a saddle too, such as an ego on
    the line between two others whose ranges are longer than the line. Where there are constraints see lagrangian.py.
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
    if (system := sparse(problem)) is not None:
        return _by_tapes(system, x)
    linear = problem.linearise(x[None])
    scheme, _ = structure(problem)
    nodes = [f.nodes for f in problem.factors]
    true = true_blocks(problem, linear)
    if not np.isfinite(true).all():
        return None
    flat, gradient = normal_equations(scheme, linear, nodes)
    gradient = gradient.ravel()
    own = scheme.pairs[:, 0] == scheme.pairs[:, 1]
    sloped = true.copy()
    sloped[own] += SLACK * flat[0][own] * np.eye(problem.space.dof)
    for blocks in (true, sloped):
        dx = _solved(scheme, blocks, gradient)
        if dx is not None:
            return float(0.5 * gradient @ dx)
    return None


def _by_tapes(system: Sparse, x: Floats) -> float | None:
    """The same of a large problem."""
    _, gradient, values = system.quadratic(x, "newton")
    if not np.isfinite(values).all():
        return None
    if not system.cholesky.factor(values):
        own = system.entries.diagonal
        values[own] += SLACK * system.quadratic(x, "gauss-newton")[2][own]
        if not system.cholesky.factor(values):
            return None
    return float(0.5 * gradient @ system.cholesky.solve(gradient))


def _solved(scheme: Pattern, blocks: Floats, rhs: Floats) -> Floats | None:
    """H^-1 rhs of symmetric blocks (P, dof, dof); None unless H is positive definite."""
    if scheme.nodes > SMALL:
        factored = cholesky_of(matrix(scheme, blocks))
        return None if factored is None else factored.solve(rhs)
    whole = dense(scheme, blocks)
    try:
        np.linalg.cholesky(whole)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(np.linalg.solve(whole, rhs))


def newton_step(problem: Problem, linear: Linear, damping: Floats) -> Floats:
    """dx (1, n, dof) of (H + diag(damping)) dx = -J^T r with the exact Hessian H of a single problem.

    Raises:
        numpy.linalg.LinAlgError: H + diag(damping) is not positive definite.
    """
    scheme, _ = structure(problem)
    _, gradient = normal_equations(scheme, linear, [f.nodes for f in problem.factors])
    blocks = true_blocks(problem, linear)
    own = np.flatnonzero(scheme.pairs[:, 0] == scheme.pairs[:, 1])
    at = np.arange(problem.space.dof)
    blocks[own[:, None], at, at] += damping[0, scheme.pairs[own, 0]]
    factored = cholesky_of(matrix(scheme, blocks))
    if factored is None:
        raise np.linalg.LinAlgError("the cost curves downwards here")
    return np.asarray(-factored.solve(gradient.ravel()).reshape(gradient.shape))


def true_blocks(problem: Problem, linear: Linear) -> Floats:
    """(P, dof, dof) blocks of the exact Hessian of a single problem, in the pattern's order."""
    x = linear.x[0]
    return assemble(structure(problem)[0], [_hessian(problem, k, x, linear) for k in range(len(problem.factors))])


def _hessian(problem: Problem, k: int, x: Floats, linear: Linear) -> list[Floats]:
    """Second derivatives (M, dof, dof) of what each measurement of a factor costs, as `assemble` takes them."""
    factor, jacobians = problem.factors[k], linear.jacobian[k]
    if factor.measurement.linear and factor.loss is None:
        return _squares([np.broadcast_to(s[0], (len(factor.nodes), *s.shape[2:])) for s in jacobians], factor.nodes)
    pair, opposed = factor.nodes.shape[1] == 2, opposite(factor, problem.movable)
    count, dof = len(factor.nodes), problem.space.dof
    local, bare = x[factor.nodes], unchecked(factor, loss=None)
    reach = STEP * np.maximum(np.linalg.norm(problem.space.position(local[:, -1] - local[:, 0] * pair), axis=-1), 1e-3)
    size = np.where(np.arange(dof)[:, None] < problem.dimension, reach, STEP)
    arity, columns = factor.nodes.shape[1], []
    for moved in range(arity - len(jacobians), arity):
        step = np.zeros((2, dof, count, arity, dof))
        for c in range(dof):
            step[:, c, :, moved, c] = size[c], -size[c]
        up, down = _gradients(problem, bare, local, step.reshape(2 * dof, count, arity, dof)).reshape(2, dof, count, -1)
        by = (up - down) / (2.0 * size[:, :, None])
        columns.append(by if problem.movable is None else by * problem.movable[factor.nodes[:, moved]].T[:, :, None])
    whole: Floats = np.concatenate(columns).transpose(1, 2, 0)
    whole = 0.5 * (whole + np.swapaxes(whole, 1, 2))
    if factor.loss is not None:
        whole = _with_loss(
            problem, factor, whole, x, _gradients(problem, bare, local, np.zeros((1, count, arity, dof)))[0]
        )
    if not pair or opposed:
        return [whole]
    first, second, between = whole[:, :dof, :dof], whole[:, dof:, dof:], whole[:, :dof, dof:]
    return [first, second, _ordered(between, factor.nodes)]


def _squares(jacobians: list[Floats], nodes: Ints) -> list[Floats]:
    """S_i^T S_i of the derivatives (M, size, dof) by one node, or also S_j^T S_j and S_i^T S_j (i the smaller)."""
    products: list[Floats] = [np.swapaxes(s, 1, 2) @ s for s in jacobians]
    if len(jacobians) == 2:
        products.append(_ordered(np.swapaxes(jacobians[0], 1, 2) @ jacobians[1], nodes))
    return products


def _ordered(between: Floats, nodes: Ints) -> Floats:
    """Blocks (M, dof, dof) of two nodes, rows of the smaller one."""
    return np.where((nodes[:, 0] > nodes[:, 1])[:, None, None], np.swapaxes(between, 1, 2), between)


def _with_loss(problem: Problem, factor: Factor, whole: Floats, x: Floats, gradient: Floats) -> Floats:
    """rho' H + 2 rho'' g g^T of H `whole` and g of the measurements without their loss.

    A difference of the robust gradient itself would need steps far below a standard deviation.
    """
    assert factor.loss is not None
    bare = linearise(problem.space, [unchecked(factor, loss=None)], problem.movable, x[None])
    square = np.square(bare.residual[0][0]).sum(axis=-1)
    outer = gradient[:, :, None] * gradient[:, None, :]
    return (
        factor.loss.weight(square)[:, None, None] * whole
        + 2.0 * factor.loss.second_derivative(square)[:, None, None] * outer
    )


def _gradients(problem: Problem, factor: Factor, local: Floats, step: Floats) -> Floats:
    """(S, M, nodes * dof) gradient of each measurement's own cost after S steps (S, M, arity, dof) of its nodes.

    Every measurement gets nodes of its own, so that one call moves them all.
    """
    space, (count, arity) = problem.space, factor.nodes.shape
    nodes = np.arange(count * arity).reshape(count, arity)
    free = None if problem.movable is None else problem.movable[factor.nodes].reshape(count * arity, -1)
    alone = unchecked(factor, nodes=nodes)
    with np.errstate(all="ignore"):
        moved = linearise(space, [alone], free, space.retract(local, step).reshape(len(step), count * arity, -1))
    jacobians, residual = moved.jacobian[0], moved.residual[0]
    if len(jacobians) > 1 and opposite(factor, problem.movable):
        jacobians = jacobians[1:]
    parts = [(np.swapaxes(s, -1, -2) @ residual[..., None])[..., 0] for s in jacobians]
    return np.concatenate(parts, axis=-1)


def dense(scheme: Pattern, blocks: Floats) -> Floats:
    """The matrix (n dof, n dof) of symmetric blocks (P, dof, dof)."""
    n, dof = scheme.nodes, blocks.shape[-1]
    whole = np.zeros((n, n, dof, dof))
    i, j = scheme.pairs.T
    whole[j, i] = blocks.swapaxes(-1, -2)
    whole[i, j] = blocks
    return whole.swapaxes(1, 2).reshape(n * dof, n * dof)


def matrix(scheme: Pattern, blocks: Floats) -> Any:
    """The sparse matrix (n dof, n dof) of symmetric blocks (P, dof, dof)."""
    from scipy.sparse import csc_array

    off = scheme.pairs[:, 0] != scheme.pairs[:, 1]
    i, j = np.concatenate([scheme.pairs, scheme.pairs[off, ::-1]]).T[:, :, None, None]
    values = np.concatenate([blocks, np.swapaxes(blocks[off], -1, -2)])
    dof = blocks.shape[-1]
    row, col = np.broadcast_arrays(dof * i + np.arange(dof)[:, None], dof * j + np.arange(dof))
    return csc_array((values.ravel(), (row.ravel(), col.ravel())), shape=(dof * scheme.nodes, dof * scheme.nodes))
