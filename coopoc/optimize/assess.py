"""What is true at a point, whoever found it: cost, gradient, covariance, the step still to go, what is left free."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Bools, Floats
from .active import Active, active_at
from .arrowhead import eliminate, marginals, structure
from .normal import Pattern, normal_equations
from .problem import Problem, jacobian

INFLATION = 1e10
"""A variance this many times what it would be with all else known counts as unbounded."""
SMALL = 200
"""Nodes up to which a problem without a hub is assessed densely."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """Of a single problem at x.

    Args:
        cost: 1/2 sum of rho. gradient: |J^T r|, or with constraints |J^T r + C^T multipliers|.
        covariance: (n, dof, dof) m^2, rad^2. remaining: m or rad, largest move of a Gauss-Newton step.
        free: names of nodes that the measurements leave free. violation: largest of a constraint, m, rad or m/s.
    """

    cost: float
    gradient: float
    covariance: Floats
    remaining: float
    free: tuple[str, ...] = ()
    violation: float = 0.0


def assess(problem: Problem, x: Floats) -> Assessment:
    """Assessment of a single problem at x (n, width)."""
    linear = problem.linearise(x[None])
    cost = float(linear.cost[0])
    scheme, frame = structure(problem)
    blocks, gradient = normal_equations(scheme, linear, [f.nodes for f in problem.factors])
    size = float(np.linalg.norm(gradient))
    active = active_at(problem, x, gradient[0]) if problem.constraints else None
    try:
        if active is not None:
            cov, dx = _bordered(jacobian(problem, linear), gradient[0], scheme.still, active)
            size = float(np.linalg.norm(gradient[0].ravel() + active.pull))
        elif problem.hub or len(x) <= SMALL:
            cov = marginals(frame, blocks)[0]
            dx = eliminate(frame, blocks, gradient, np.zeros_like(gradient))[0]
        else:
            cov, dx = _sparse(jacobian(problem, linear), gradient[0], scheme.still)
        sound = active is not None or bounded(scheme, blocks, cov[None]).all()
        if sound and np.isfinite(dx).all() and np.isfinite(cov).all():
            if scheme.still is not None:
                cov = cov * ~(scheme.still[:, :, None] | scheme.still[:, None, :])
            violation = 0.0 if active is None else active.violation
            return Assessment(cost, size, cov, float(np.abs(dx).max(initial=0.0)), (), violation)
    except np.linalg.LinAlgError:
        pass
    unknown = np.full((len(x), problem.space.dof, problem.space.dof), np.nan)
    violation = 0.0 if active is None else active.violation
    return Assessment(cost, size, unknown, np.nan, _free(problem, jacobian(problem, linear), active), violation)


def bounded(scheme: Pattern, blocks: Floats, cov: Floats) -> Bools:
    """(B,) True where no variance of cov (B, n, dof, dof) exceeds INFLATION times its value with all else known."""
    own = np.zeros(cov.shape[:3])
    diagonal = scheme.pairs[:, 0] == scheme.pairs[:, 1]
    own[:, scheme.pairs[diagonal, 0]] = np.einsum("bpii->bpi", blocks[:, diagonal])
    inflation = own * np.einsum("bnii->bni", cov)
    sound: Bools = ((inflation > 0) & (inflation < INFLATION)).all(axis=(1, 2))
    return sound


def _sparse(J: Any, gradient: Floats, still: Bools | None) -> tuple[Floats, Floats]:
    """Marginals (n, dof, dof) and Gauss-Newton step (n, dof) through one sparse factorisation."""
    factored = factorise(J.T @ J, still)
    return _diagonal_blocks(factored, *gradient.shape), -factored.solve(gradient.ravel()).reshape(gradient.shape)


def _bordered(J: Any, gradient: Floats, still: Bools | None, active: Active) -> tuple[Floats, Floats]:
    """Marginals under the equalities, and the Newton step of the constrained problem, from the bordered system."""
    from scipy.sparse import csc_array, diags_array

    hessian = (J.T @ J).tocsc()
    hessian = hessian + diags_array((np.zeros(hessian.shape[0]) if still is None else still.ravel()) * 1.0)
    steps, covs = [], []
    for rows, gap in ((active.matrix, active.gap), (active.matrix[active.equality], active.gap[active.equality])):
        zero = csc_array((rows.shape[0], rows.shape[0]))
        from scipy.sparse import block_array

        system = block_array([[hessian, rows.T], [rows, zero]], format="csc") if rows.shape[0] else hessian
        factored = factorise(system, None)
        steps.append(factored.solve(np.concatenate([-gradient.ravel(), -gap]))[: gradient.size])
        covs.append(factored)
    return _diagonal_blocks(covs[1], *gradient.shape), steps[0].reshape(gradient.shape)


def factorise(matrix: Any, still: Bools | None) -> Any:
    """Sparse LU of a symmetric matrix, 1 added to the diagonal of what is `still`; LinAlgError if it is singular."""
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    whole = matrix if still is None else matrix + diags_array(still.ravel().astype(np.float64))
    try:
        return splu(whole.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError as singular:
        raise np.linalg.LinAlgError(str(singular)) from singular


def _diagonal_blocks(factored: Any, n: int, dof: int) -> Floats:
    cov = np.empty((n, dof, dof))
    rows = factored.shape[0]
    for first in range(0, n, 100):
        nodes = np.arange(first, min(first + 100, n))
        rhs = np.zeros((rows, dof * len(nodes)))
        rhs[dof * first + np.arange(rhs.shape[1]), np.arange(rhs.shape[1])] = 1.0
        columns = factored.solve(rhs)[: n * dof].reshape(n, dof, len(nodes), dof)
        cov[nodes] = columns[nodes, :, np.arange(len(nodes)), :]
    return cov


def _free(problem: Problem, J: Any, active: Active | None) -> tuple[str, ...]:
    """Nodes that take part in a direction which no measurement sees: the null space of J with unit columns."""
    dense = J.toarray()
    if active is not None:
        dense = np.concatenate([dense, active.matrix.toarray()])
    length = np.linalg.norm(dense, axis=0)
    unit = dense / np.where(length > 0, length, 1.0)
    _, values, rows = np.linalg.svd(unit, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(rows) - len(values))])
    null = rows[values <= 1e-5 * values.max(initial=1.0)]
    if problem.free is not None:
        null = null * problem.free.ravel()
    moves = np.square(null).sum(axis=0).reshape(len(problem.names), -1).sum(axis=1)
    return tuple(name for name, m in zip(problem.names, moves, strict=True) if m > 1e-6)
