"""Cost, gradient, covariance, remaining step and unobservable nodes at a point, independently of the solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ...arrays import Bools, Floats
from ..algebra.arrowhead import marginals, structure
from ..algebra.cholesky import cholesky_of, with_still
from ..algebra.dense import diagonal_blocks, is_small, normal_matrix
from ..algebra.normal import Pattern, normal_equations
from ..algebra.sparse import Sparse, sparse
from ..model.linear import Linear
from ..model.problem import Problem
from .active import Active, active_at
from .curvature import matrix as sparse_matrix

INFLATION = 1e10
"""A variance this many times what it would be with all else known counts as unbounded."""
CANCELLED = 1e-7
"""Share of its terms that a row may keep along a direction that it does not see."""
SMALL = 200
"""Nodes up to which a problem without a separator is assessed densely."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """Of a single problem at x.

    Args:
        cost: 1/2 sum of rho.
        gradient_norm: |J^T r|, or with constraints |J^T r + C^T multipliers|.
        covariance: (n, dof, dof) m^2, rad^2.
        remaining: m or rad, largest move of a Gauss-Newton step.
        promised: decrease of the cost that this step promises; infinite where constraints hold it.
        unobservable: names of nodes that can move without changing the cost.
        violation: largest of a constraint, m, rad or m/s.
        violated: which constraint that is, in words.
        active: what holds x, None without constraints.
    """

    cost: float
    gradient_norm: float
    covariance: Floats
    remaining: float
    unobservable: tuple[str, ...] = ()
    violation: float = 0.0
    violated: str = ""
    active: Active | None = None
    promised: float = np.inf


def assess(problem: Problem, x: Floats) -> Assessment:
    """Assessment of a single problem at x (n, ambient)."""
    if (system := sparse(problem)) is not None:
        return _as_graph(problem, system, x)
    linear = problem.linearise(x[None])
    cost = float(linear.cost[0])
    gradient, unconstrained = (_as_matrix if is_small(problem) else _as_blocks)(problem, linear)
    size = float(np.linalg.norm(gradient))
    active = active_at(problem, x, gradient) if problem.constraints else None
    violation, violated = (0.0, "") if active is None else (active.violation, active.violated)
    if active is not None:
        size = float(np.linalg.norm(gradient.ravel() + active.constraint_gradient))
    still = None if problem.movable is None else ~problem.movable
    try:
        if active is not None and active.holds:
            cov, dx, sound = _restricted(problem.jacobian(linear), gradient, still, active)
        else:
            cov, dx, sound = unconstrained()
        if sound and np.isfinite(dx).all() and np.isfinite(cov).all():
            if still is not None:
                cov = cov * ~(still[:, :, None] | still[:, None, :])
            remaining = float(np.abs(dx).max(initial=0.0))
            promised = np.inf if active is not None else -0.5 * float(np.vdot(gradient, dx))
            return Assessment(cost, size, cov, remaining, (), violation, violated, active, promised)
    except np.linalg.LinAlgError:
        pass
    unknown = np.full((len(x), problem.space.dof, problem.space.dof), np.nan)
    unobservable = _unobservable(problem, problem.jacobian(linear), active)
    return Assessment(cost, size, unknown, np.nan, unobservable, violation, violated, active)


def _as_graph(problem: Problem, system: Sparse, x: Floats) -> Assessment:
    """The assessment of a problem by tapes and its own factors."""
    cholesky = system.cholesky
    cost, gradient, values = system.quadratic(x, "gauss-newton")
    size = float(np.sqrt(gradient @ gradient))

    def failed(known: tuple[str, ...] | None = None) -> Assessment:
        nodes = _unobservable(problem, problem.jacobian(problem.linearise(x[None])), None) if known is None else known
        return Assessment(cost, size, np.full((len(x), problem.space.dof, problem.space.dof), np.nan), np.nan, nodes)

    if not np.isfinite(values).all():
        return failed(())
    if not cholesky.factor(values):
        return failed()
    dx = -cholesky.solve(gradient)
    free, rows, columns = system.entries.own
    found, cov = cholesky.inverse(rows, columns), np.zeros(free.shape)
    cov[free] = found
    inflation = found[rows == columns] * values[system.entries.diagonal]
    remaining, promised = float(np.abs(dx).max(initial=0.0)), -0.5 * float(gradient @ dx)
    if not (inflation < INFLATION).all() and (without := failed()).unobservable:
        return without
    return Assessment(cost, size, cov, remaining, promised=promised)


Marginals: TypeAlias = Callable[[], tuple[Floats, Floats, bool]]
"""Marginals (n, dof, dof), Gauss-Newton step (n, dof), and whether the former are bounded."""


def _as_matrix(problem: Problem, linear: Linear) -> tuple[Floats, Marginals]:
    """Gradient (n, dof) and what follows from one matrix."""
    matrix, eta = normal_matrix(problem, linear)
    gradient = eta.reshape(len(problem.names), -1)

    def unconstrained() -> tuple[Floats, Floats, bool]:
        cov, inverse = diagonal_blocks(matrix, len(gradient))
        inflation = matrix.diagonal() * inverse.diagonal()
        return cov, -(inverse @ eta).reshape(gradient.shape), bool(((inflation > 0) & (inflation < INFLATION)).all())

    return gradient, unconstrained


def _as_blocks(problem: Problem, linear: Linear) -> tuple[Floats, Marginals]:
    """The same from blocks, by their Schur complement or sparse."""
    scheme, frame = structure(problem)
    blocks, gradient = normal_equations(scheme, linear, [f.nodes for f in problem.factors])

    def unconstrained() -> tuple[Floats, Floats, bool]:
        if problem.separator or len(gradient[0]) <= SMALL:
            cov, dx = (each[0] for each in marginals(frame, blocks, gradient))
        else:
            cov, dx = _sparse(sparse_matrix(scheme, blocks[0]), gradient[0])
        return cov, dx, bool(bounded(scheme, blocks, cov[None]).all())

    return gradient[0], unconstrained


def bounded(scheme: Pattern, blocks: Floats, cov: Floats) -> Bools:
    """(B,) True where no variance of cov (B, n, dof, dof) exceeds INFLATION times its value with all else known."""
    own = np.zeros(cov.shape[:3])
    diagonal = scheme.pairs[:, 0] == scheme.pairs[:, 1]
    own[:, scheme.pairs[diagonal, 0]] = np.einsum("bpii->bpi", blocks[:, diagonal])
    inflation = own * np.einsum("bnii->bni", cov)
    sound: Bools = ((inflation > 0) & (inflation < INFLATION)).all(axis=(1, 2))
    return sound


def _sparse(matrix: Any, gradient: Floats) -> tuple[Floats, Floats]:
    """Marginals (n, dof, dof) and Gauss-Newton step (n, dof) by one sparse factorisation of J^T J."""
    cholesky = cholesky_of(matrix)
    if cholesky is None:
        raise np.linalg.LinAlgError("J^T J is not positive definite")
    n, dof = gradient.shape
    row = np.arange(n * dof).reshape(n, dof, 1).repeat(dof, axis=2)
    cov = cholesky.inverse(row.ravel(), row.swapaxes(1, 2).ravel()).reshape(row.shape)
    return cov, -cholesky.solve(gradient.ravel()).reshape(gradient.shape)


def _restricted(J: Any, gradient: Floats, still: Bools | None, active: Active) -> tuple[Floats, Floats, bool]:
    """Marginals under the equalities, the Gauss-Newton step along what holds, and whether the former are bounded.

    With Z the directions that remain: cov = Z (Z^T J^T J Z)^-1 Z^T, and the step solves the same system after the least
    step onto what holds.
    """
    hessian = with_still(J.T @ J, still)
    solve, _ = _within(hessian, active.along)
    dx = active.onto - solve(gradient.ravel() + hessian @ active.onto)
    solve, own = _within(hessian, active.exact)
    cov = _diagonal_blocks(solve, *gradient.shape)
    inflation = own * np.einsum("nii->ni", cov).ravel()
    moves = np.asarray(active.exact.multiply(active.exact).sum(axis=1)).ravel() > 1e-9
    sound = ((own > 1e-13 * own.max(initial=0.0)) & (inflation > 0) & (inflation < INFLATION))[moves].all()
    return cov, dx.reshape(gradient.shape), bool(sound)


def _within(hessian: Any, ways: Any) -> tuple[Callable[[Floats], Floats], Floats]:
    """Z (Z^T H Z)^-1 Z^T of directions Z (n dof, k) as a function, and the diagonal of H seen along Z."""
    if not ways.shape[1]:
        return np.zeros_like, np.zeros(ways.shape[0])
    reduced = ways.T @ hessian @ ways
    factored = factorise(reduced)
    return lambda rhs: ways @ factored.solve(ways.T @ rhs), (ways @ reduced @ ways.T).diagonal()


def factorise(matrix: Any) -> Any:
    """Sparse LU of a symmetric matrix; LinAlgError if it is singular."""
    from scipy.sparse.linalg import splu

    try:
        return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError as singular:
        raise np.linalg.LinAlgError(str(singular)) from singular


def _diagonal_blocks(solve: Callable[[Floats], Floats], n: int, dof: int) -> Floats:
    cov = np.empty((n, dof, dof))
    for first in range(0, n, 100):
        nodes = np.arange(first, min(first + 100, n))
        rhs = np.zeros((n * dof, dof * len(nodes)))
        rhs[dof * first + np.arange(rhs.shape[1]), np.arange(rhs.shape[1])] = 1.0
        columns = solve(rhs).reshape(n, dof, len(nodes), dof)
        cov[nodes] = columns[nodes, :, np.arange(len(nodes)), :]
    return cov


def _unobservable(problem: Problem, J: Any, active: Active | None) -> tuple[str, ...]:
    """Nodes that take part in a direction which no measurement sees: the null space of J with unit columns."""
    from scipy.sparse import eye_array

    ways = eye_array(J.shape[1], format="csc") if active is None else active.exact
    J = (J @ ways).tocsc()
    length = np.sqrt(np.asarray(J.multiply(J).sum(axis=0)).ravel())
    measured = length > 0
    null = _null_rows(J[:, measured], length[measured]) @ ways[:, measured].T
    moves = np.square(null).sum(axis=0) + np.asarray(ways[:, ~measured].power(2).sum(axis=1)).ravel()
    if problem.movable is not None:
        moves = moves * problem.movable.ravel()
    moves = moves.reshape(len(problem.names), -1).sum(axis=1)
    return tuple(name for name, m in zip(problem.names, moves, strict=True) if m > 1e-6)


def _null_rows(J: Any, length: Floats) -> Floats:
    """Rows that span the null space of J with unit columns; where J is large, those that inverse iteration finds.

    Args:
        J: (m, k) sparse.
        length: (k,) of its columns, > 0.
    """
    from scipy.sparse import diags_array

    unit = (J @ diags_array(1.0 / length)).tocsc()
    square = unit.T @ unit
    if len(length) <= SMALL:
        values, ways = np.linalg.eigh(square.toarray())
        return np.asarray(ways[:, values <= 1e-10 * values.max(initial=1.0)].T)
    factored = factorise(square + diags_array(np.full(len(length), 1e-12)))
    ways = np.random.default_rng(0).standard_normal((len(length), 12))
    for _ in range(6):
        ways = np.linalg.qr(factored.solve(ways))[0]
    ways = ways @ np.linalg.eigh(ways.T @ (square @ ways))[1]
    return np.asarray(ways[:, ~_seen(unit, ways)].T)


def _seen(J: Any, ways: Floats) -> Bools:
    """(K,) whether a row of J sees a direction (columns of `ways`), whatever its weight.

    Along a direction that nothing measures the terms of every row cancel to rounding; where one is only weakly held,
    some row keeps a share of its terms.
    """
    from scipy.sparse import diags_array

    largest = abs(J).max(axis=1).toarray().ravel()
    rows = diags_array(1.0 / np.where(largest > 0, largest, 1.0)) @ J
    left, terms = np.abs(rows @ ways), abs(rows) @ np.abs(ways)
    matters = terms > 1e-6 * terms.max(axis=0)  # a chain bends by angles that are small beside its length
    return np.asarray((matters & (left > CANCELLED * terms)).any(axis=0))
