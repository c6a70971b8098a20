"""Damped Newton steps over Stiefel blocks and spheres by one sparse factorisation each, for thousands of poses.

In an orthonormal basis B of the tangent space at X the Hessian of 1/2 <Q, X X^T> is B^T ((Q - diag(L, 0)) x I_p) B, as
sparse as the graph. Conjugate gradients need hundreds of products where chains of odometry bend.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ..algebra.cholesky import Cholesky
from .manifold import MAX_ITERATIONS, Stationary, retract
from .qcqp import Multipliers, Quadratic, multipliers
from .schur import Sparse

LEAST = 1e-12
"""Damping beside the diagonal of Q of a step that needs none, since common rotations are free."""
FIRST = 1e-6
"""Damping once some is needed."""
MOST = 1e6
"""Damping beyond which no step can help."""


def tangent_basis(form: Quadratic, X: Floats, size: int) -> Any:
    """B (size p, k) of the rows (size, p), of which those beyond the constrained ones are free; orthonormal columns.

    Stiefel block (k, p): skew Omega X_B and K X_B^perp; sphere: what is orthogonal to it.
    """
    from scipy.sparse import csr_array

    p = X.shape[1]
    parts = [(_stiefel(X[form.stiefel]), form.stiefel), (_sphere(X[form.sphere]), form.sphere)]
    data, row, column, used = [], [], [], 0
    for basis, rows in parts:
        count, k, _ = basis.shape
        entries = (rows[:, :, None] * p + np.arange(p)).reshape(count, 1, -1)
        at = used + np.arange(count * k).reshape(count, k, 1)
        data.append(basis.ravel())
        row.append(np.broadcast_to(entries, basis.shape).ravel())
        column.append(np.broadcast_to(at, basis.shape).ravel())
        used += count * k
    free = np.arange(form.bound * p, size * p)
    data.append(np.ones(len(free)))
    row.append(free)
    column.append(used + np.arange(len(free)))
    where = np.concatenate(row), np.concatenate(column)
    return csr_array((np.concatenate(data), where), shape=(size * p, used + len(free)))


def _stiefel(X: Floats) -> Floats:
    """(n, dof, k p) tangents of (n, k, p) blocks of orthonormal rows."""
    n, k, p = X.shape
    a, b = np.triu_indices(k, 1)
    skew = np.zeros((n, len(a), k, p))
    skew[:, np.arange(len(a)), a] = X[:, b] / np.sqrt(2.0)
    skew[:, np.arange(len(a)), b] = -X[:, a] / np.sqrt(2.0)
    beside = np.linalg.svd(X, full_matrices=True)[2][:, k:] if n else np.empty((0, p - k, p))
    across = np.zeros((n, k, p - k, k, p))
    across[:, np.arange(k), :, np.arange(k)] = beside
    return np.concatenate([skew.reshape(n, -1, k * p), across.reshape(n, -1, k * p)], axis=1)


def _sphere(X: Floats) -> Floats:
    """(m, q p - 1, q p) tangents of (m, q, p) blocks of unit length."""
    flat = X.reshape(len(X), 1, -1)
    if not len(X):
        return np.empty((0, flat.shape[2] - 1, flat.shape[2]))
    return np.linalg.svd(flat, full_matrices=True)[2][:, 1:]


class _System:
    """Factors of Hessians over the tangent space, whose pattern holds whatever cancels at one point."""

    def __init__(self, form: Quadratic, gram: Any, X: Floats) -> None:
        from scipy.sparse import block_diag, csc_array, csc_matrix, kron, triu

        size, p = gram.shape[0], X.shape[1]
        basis = abs(tangent_basis(form, X, size))
        basis.data[:] = 1.0
        blocks = Multipliers(
            form, np.ones((len(form.stiefel), *[form.stiefel.shape[1]] * 2)), np.ones(len(form.sphere))
        )
        rest = csc_array((size - form.bound, size - form.bound))
        whole = abs(gram) + block_diag([blocks.sparse, rest])
        self._pattern = csc_matrix(triu(basis.T @ kron(whole, np.ones((p, p)), format="csr") @ basis))
        self._pattern.sort_indices()
        k, q = (form.stiefel.shape[1], form.sphere.shape[1]) if form.bound else (0, 0)
        dof = k * p - k * (k + 1) // 2, q * p - 1
        count = len(form.stiefel), len(form.sphere), size - form.bound
        group = np.repeat(np.arange(sum(count)), np.repeat([*dof, p], count))
        self.cholesky = Cholesky(self._pattern.indptr, self._pattern.indices, group)
        self._keys = _keys(self._pattern)

    def factor(self, hessian: Any, damping: Floats) -> bool:
        """Factor a Hessian and a diagonal; whether it is positive definite."""
        from scipy.sparse import csc_matrix, triu

        values, upper = np.zeros(len(self._keys)), csc_matrix(triu(hessian))
        values[np.searchsorted(self._keys, _keys(upper))] = upper.data
        values[self._pattern.indptr[1:] - 1] += damping
        return self.cholesky.factor(values)


def _keys(matrix: Any) -> Ints:
    """(entries,) column and row of each as one number."""
    column = np.repeat(np.arange(matrix.shape[1], dtype=np.int64), np.diff(matrix.indptr))
    return np.asarray(column * matrix.shape[0] + matrix.indices)


def minimise_sparsely(
    form: Quadratic,
    reduced: Sparse,
    X: Floats,
    tolerance: float = 1e-11,
    deadline: float = np.inf,
    tick: Callable[[], object] = lambda: None,
) -> Stationary:
    """A stationary point near X (bound, p), or where the time is over, as `minimise` of manifold.py.

    Args:
        tolerance: of the decrease that a step promises, as a share of the cost (at least of 1).
        deadline: time.perf_counter() at which to stop.
        tick: called after every step.
    """
    from scipy.sparse import eye_array, kron

    gram, size = reduced.gram, reduced.gram.shape[0]
    system = _System(form, gram, X)
    CX = reduced.times(X)
    cost, mu, count = 0.5 * float(np.sum(X * CX)), LEAST, 0
    while True:
        L = multipliers(form, X, CX)
        gradient = np.zeros((size, X.shape[1]))
        gradient[: form.bound] = CX - L.times(X)
        B = tangent_basis(form, X, size)
        hessian = B.T @ kron(reduced.shifted(L.sparse, 0.0), eye_array(X.shape[1]), format="csr") @ B
        scale = (B.multiply(B).T @ np.repeat(gram.diagonal(), X.shape[1])).ravel()
        g, moved = B.T @ gradient.ravel(), False
        while not moved:
            definite = system.factor(hessian, mu * scale)
            count += 1
            tick()
            if definite:
                xi = -system.cholesky.solve(g)
                promised = 0.5 * float(mu * scale @ (xi * xi) - g @ xi)
                trial = retract(form, X, (B @ xi).reshape(size, -1)[: form.bound])
                CT = reduced.times(trial)
                after = 0.5 * float(np.sum(trial * CT))
                small = promised <= tolerance * max(cost, 1.0)
                share = 1.0 if small and after <= cost * (1.0 + 1e-12) else (cost - after) / promised
                moved = share > 0.0
                if moved:
                    X, CX, cost = trial, CT, after
                if small or mu > MOST:
                    return Stationary(X, cost, multipliers(form, X, CX), count, small)
                mu = max(mu / 5.0, LEAST) if share > 0.75 else mu if share > 0.25 else max(10.0 * mu, FIRST)
            else:
                mu = max(10.0 * mu, FIRST)
            if count >= MAX_ITERATIONS or time.perf_counter() > deadline:
                return Stationary(X, cost, multipliers(form, X, CX), count, False)
