"""Cost, gradient, covariance, remaining step and unobservable nodes at a point, independently of the solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Bools, Floats
from ..algebra.cholesky import Cholesky, cholesky_of, with_still
from ..algebra.sparse import Sparse, sparse
from ..model.problem import Problem
from .active import Active, active_at

INFLATION = 1e10
"""A variance this many times what it would be with all else known counts as unbounded."""
CANCELLED = 1e-7
"""Share of its terms that a row may keep along a direction that it does not see."""
SMALL = 200
"""Columns up to which the null space of J is that of a dense matrix."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """Of a single problem at x.

    Args:
        cost: 1/2 sum of rho.
        gradient_norm: |J^T r|, or with constraints |J^T r + C^T multipliers|.
        covariance: (n, dof, dof) m^2, rad^2.
        remaining: m or rad, largest move of a Gauss-Newton step.
        unobservable: names of nodes that can move without changing the cost.
        active: what holds x, None without constraints.
        promised: decrease of the cost that this step promises; infinite where constraints hold it.
    """

    cost: float
    gradient_norm: float
    covariance: Floats
    remaining: float
    unobservable: tuple[str, ...] = ()
    active: Active | None = None
    promised: float = np.inf

    @property
    def violation(self) -> float:
        """Largest of a constraint, m, rad or m/s."""
        return 0.0 if self.active is None else self.active.violation


def assess(problem: Problem, x: Floats) -> Assessment:
    """Assessment of a single problem at x (n, ambient)."""
    if not problem.constraints:
        return _unconstrained(problem, sparse(problem), x)
    linear = problem.linearise(x[None])
    J, shape = problem.jacobian(linear), (len(x), problem.space.dof)
    gradient = J.T @ np.concatenate([r.ravel() for r in linear.residual])
    active = active_at(problem, x, gradient.reshape(shape))
    size = float(np.linalg.norm(gradient + active.constraint_gradient))
    still = None if problem.movable is None else ~problem.movable
    try:
        cov, dx, sound = _marginals(with_still(J.T @ J, still), gradient, shape, active)
    except np.linalg.LinAlgError:
        sound = False
    if not sound or not (np.isfinite(dx).all() and np.isfinite(cov).all()):
        unknown = np.full((*shape, shape[1]), np.nan)
        return Assessment(float(linear.cost[0]), size, unknown, np.nan, _unobservable(problem, J, active), active)
    if still is not None:
        cov = cov * ~(still[:, :, None] | still[:, None, :])
    return Assessment(float(linear.cost[0]), size, cov, float(np.abs(dx).max(initial=0.0)), (), active)


def _unconstrained(problem: Problem, system: Sparse, x: Floats) -> Assessment:
    """The assessment of a problem without constraints."""
    cholesky = system.cholesky
    cost, gradient, values = system.quadratic(x, "gauss-newton")
    size = float(np.sqrt(gradient @ gradient))
    unknown = Assessment(cost, size, np.full((len(x), *(problem.space.dof,) * 2), np.nan), np.nan)
    if not np.isfinite(values).all():
        return unknown
    dx: Floats = np.zeros(0)
    inflation: Floats = np.full(1, np.inf)
    if cholesky.factor(values):
        dx = -cholesky.solve(gradient)
        free, rows, columns = system.entries.own
        found, cov = cholesky.inverse(rows, columns), np.zeros(free.shape)
        cov[free] = found
        inflation = found[rows == columns] * values[system.entries.diagonal]
    if not (inflation < INFLATION).all():
        nodes = _unobservable(problem, problem.whiten(x)[1], None)
        if nodes or not len(dx):
            return Assessment(cost, size, unknown.covariance, np.nan, nodes)
    promised = -0.5 * float(gradient @ dx)
    return Assessment(cost, size, cov, float(np.abs(dx).max(initial=0.0)), promised=promised)


def _marginals(hessian: Any, gradient: Floats, shape: tuple[int, int], active: Active) -> tuple[Floats, Floats, bool]:
    """Marginals under the equalities, the Gauss-Newton step along what holds, and whether the former are bounded.

    With Z the directions that remain: cov = Z (Z^T J^T J Z)^-1 Z^T, and the step solves the same system after the least
    step onto what holds.

    Raises:
        numpy.linalg.LinAlgError: a matrix that is not positive definite.
    """
    exact, onto = active.exact, active.onto
    dx = onto - _within(hessian, active.along)[0](gradient + hessian @ onto)
    solve, own = _within(hessian, exact)
    cov = np.zeros((shape[0], shape[1], shape[1]))
    for i, c in np.ndindex(*shape):
        unit = np.zeros(shape)
        unit[i, c] = 1.0
        cov[i, :, c] = solve(unit.ravel()).reshape(shape)[i]
    inflation = own * np.einsum("nii->ni", cov).ravel()
    moves = np.asarray(exact.multiply(exact).sum(axis=1)).ravel() > 1e-9
    sound = ((own > 1e-13 * own.max(initial=0.0)) & (inflation > 0) & (inflation < INFLATION))[moves].all()
    return cov, dx, bool(sound)


def _within(hessian: Any, ways: Any) -> tuple[Callable[[Floats], Floats], Floats]:
    """Z (Z^T H Z)^-1 Z^T of directions Z (n dof, k) as a function, and the diagonal of H seen along Z."""
    if not ways.shape[1]:
        return np.zeros_like, np.zeros(ways.shape[0])
    reduced = ways.T @ hessian @ ways
    factored = cholesky_of(reduced)
    if factored is None:
        raise np.linalg.LinAlgError("not positive definite")
    return lambda rhs: ways @ factored.solve(ways.T @ rhs), (ways @ reduced @ ways.T).diagonal()


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
    shift, factored = 1e-12, None
    while factored is None:
        factored, shift = cholesky_of(with_still(square, np.full(len(length), shift))), 10.0 * shift
    ways = np.random.default_rng(0).standard_normal((len(length), 12))
    for _ in range(6):
        ways = np.linalg.qr(_solved(factored, ways))[0]
    ways = ways @ np.linalg.eigh(ways.T @ (square @ ways))[1]
    return np.asarray(ways[:, ~_seen(unit, ways)].T)


def _solved(factored: Cholesky, right: Floats) -> Floats:
    return np.stack([factored.solve(np.ascontiguousarray(column)) for column in right.T], axis=1)


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
