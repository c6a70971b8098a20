"""What is true at a point, whoever found it: cost, gradient, covariance, the step still to go, what is left free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats
from .arrowhead import eliminate, marginals, structure
from .normal import Pattern, normal_equations
from .problem import Problem, jacobian

INFLATION = 1e10
"""A variance this many times what it would be with all else known counts as unbounded."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """Of a single problem at x.

    Args:
        cost: 1/2 r.r. gradient: |J^T r|. covariance: (n, 3, 3) m^2. remaining: m, largest move of a Gauss-Newton step.
        free: names of points that the measurements leave free.
    """

    cost: float
    gradient: float
    covariance: Floats
    remaining: float
    free: tuple[str, ...]


def assess(problem: Problem, x: Floats) -> Assessment:
    """Assessment of a single problem at x (n, 3) m."""
    linear = problem.linearise(x[None])
    cost = float(linear.cost[0])
    small = bool(problem.hub) or len(x) <= 200
    scheme, frame = structure(problem)
    blocks, gradient = normal_equations(scheme, linear)
    size = float(np.linalg.norm(gradient))
    try:
        if small:
            cov = marginals(frame, blocks)[0]
            dx = eliminate(frame, blocks, gradient, np.zeros_like(gradient))[0]
        else:
            cov, dx = _sparse(jacobian(problem, linear), gradient[0])
        if bounded(scheme, blocks, cov[None]).all() and np.isfinite(dx).all():
            return Assessment(cost, size, cov, float(np.abs(dx).max(initial=0.0)), ())
    except np.linalg.LinAlgError:
        pass
    unknown = np.full((len(x), 3, 3), np.nan)
    return Assessment(cost, size, unknown, np.nan, _free(problem, jacobian(problem, linear)))


def bounded(scheme: Pattern, blocks: Floats, cov: Floats) -> Bools:
    """(B,) True where no variance of cov (B, n, 3, 3) exceeds INFLATION times what it would be with all else known."""
    own = np.zeros(cov.shape[:3])
    diagonal = scheme.pairs[:, 0] == scheme.pairs[:, 1]
    own[:, scheme.pairs[diagonal, 0]] = np.einsum("bpii->bpi", blocks[:, diagonal])
    inflation = own * np.einsum("bnii->bni", cov)
    sound: Bools = ((inflation > 0) & (inflation < INFLATION)).all(axis=(1, 2))
    return sound


def _sparse(J: object, gradient: Floats) -> tuple[Floats, Floats]:
    """Marginals (n, 3, 3) and Gauss-Newton step (n, 3) through one sparse factorisation."""
    from scipy.sparse.linalg import splu

    try:
        factored = splu((J.T @ J).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})  # type: ignore[attr-defined]
    except RuntimeError as singular:
        raise np.linalg.LinAlgError(str(singular)) from singular
    n = len(gradient)
    cov = np.empty((n, 3, 3))
    for first in range(0, n, 100):
        points = np.arange(first, min(first + 100, n))
        rhs = np.zeros((3 * n, 3 * len(points)))
        rhs[3 * first + np.arange(rhs.shape[1]), np.arange(rhs.shape[1])] = 1.0
        columns = factored.solve(rhs).reshape(n, 3, len(points), 3)
        cov[points] = columns[points, :, np.arange(len(points)), :]
    return cov, -factored.solve(gradient.ravel()).reshape(n, 3)


def _free(problem: Problem, J: object) -> tuple[str, ...]:
    """Points that take part in a direction which no measurement sees: the null space of J with unit columns."""
    dense = J.toarray()  # type: ignore[attr-defined]
    length = np.linalg.norm(dense, axis=0)
    unit = dense / np.where(length > 0, length, 1.0)
    _, values, rows = np.linalg.svd(unit, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(rows) - len(values))])
    null = rows[values <= 1e-5 * values.max(initial=1.0)]
    moves = np.square(null).sum(axis=0).reshape(-1, 3).sum(axis=1)
    return tuple(name for name, m in zip(problem.names, moves, strict=True) if m > 1e-6)
