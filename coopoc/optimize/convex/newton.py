"""Riemannian Newton steps on a QCQP's constrained rows, its free positions eliminated, and the bound they prove.

1/2 |A X|^2 is smallest over the free rows at X_f = -Q_ff^-1 Q_fc X_c, Q = A^T A, and is then 1/2 <C, X_c X_c^T> with
C = Q_cc - Q_cf Q_ff^-1 Q_fc. Whatever block-diagonal L is subtracted, C - L is the Schur complement of Q - diag(L, 0).

In an orthonormal basis B of the tangent space at X the Hessian of 1/2 <Q, X X^T> is B^T ((Q - diag(L, 0)) x I_p) B, as
sparse as the graph, with the multipliers of the constraints

    L_B = sym((C X)_B X_B^T) on a Stiefel block,     L_B = <(C X)_B, X_B> I on a sphere.

Conjugate gradients would need hundreds of products where chains of odometry bend. Steps as in Absil, Mahony and
Sepulchre, Optimization Algorithms on Matrix Manifolds, 2008.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..algebra.cholesky import Cholesky, cholesky_of, columns_solved
from ..descent.levenberg_marquardt import DECAY, GROWTH
from .qcqp import Multipliers, Quadratic, multipliers

DENSE = 500
"""Up to this many constrained rows C is formed."""
SMALL = 200
"""Up to this many rows of X all matrices are dense."""
MAX_ITERATIONS = 300
LOOSE = 1e-10
"""Share of the largest singular value below which positions are free."""
LEAST = 1e-12
"""Damping beside the diagonal of Q of a step that needs none, since common rotations are free."""
FIRST = 1e-6
"""Damping once some is needed."""
MOST = 1e6
"""Damping beyond which no step can help."""
ROUNDED = 2.0**-51
"""Share of the diagonal of Q by which C may be off: at most 0.84 of 2^-52 where fractions give the cost."""
PROMISE = 1e-11
"""Share of the cost, or of 1, whose promise by a step ends the loop; the step is still taken."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """C through a sparse factorisation of Q."""

    problem: Quadratic

    @cached_property
    def _kept(self) -> Bools:
        """False for the first position of each part that could be moved as a whole: it is fixed at zero."""
        from scipy.sparse import csc_array
        from scipy.sparse.csgraph import connected_components

        bound, width = self.problem.bound, self.problem.dimension if self.problem.stacked else 1
        free = self.problem.rows[:, bound:].tocsc()
        part = connected_components(free.T @ free, directed=False)[1]
        _, first, label = np.unique(part * width + np.arange(len(part)) % width, return_index=True, return_inverse=True)
        whole = csc_array((np.ones(len(label)), (np.arange(len(label)), label)), shape=(len(label), len(first)))
        moved, terms = (abs(each).max(axis=0).toarray().ravel() for each in (free @ whole, abs(free) @ whole))
        kept = np.ones(self.problem.rows.shape[1], dtype=bool)
        kept[bound + first[moved <= 1e-9 * terms]] = False
        return kept

    @cached_property
    def _rows(self) -> Any:
        """A without what is fixed at zero."""
        return self.problem.rows[:, self._kept]

    @cached_property
    def gram(self) -> Any:
        """Q."""
        return (self._rows.T @ self._rows).tocsc()

    @cached_property
    def _inverse(self) -> Cholesky:
        found = cholesky_of(self.gram[self.problem.bound :, self.problem.bound :])
        assert found is not None  # what could be moved as a whole is not among the rows
        return found

    @cached_property
    def _small(self) -> tuple[Floats, Floats] | None:
        """A, and all rows of X over the constrained ones, by the pseudo-inverse, where a dense matrix is faster."""
        A, bound = self.problem.rows, self.problem.bound
        if A.shape[1] > SMALL:
            return None
        A = A.toarray()
        free = np.linalg.pinv(A[:, bound:], rcond=LOOSE) @ A[:, :bound]
        return A, np.concatenate([np.eye(bound), -free])

    def _all(self, X: Floats) -> Floats:
        """The constrained rows X and the free ones where the cost is smallest."""
        bound = self.problem.bound
        if self._small is not None:
            return self._small[1] @ X
        right = -(self._rows[:, bound:].T @ (self._rows[:, :bound] @ X))
        return np.concatenate([X, columns_solved(self._inverse, right)])

    def times(self, X: Floats) -> Floats:
        """C X."""
        if self.problem.bound <= DENSE:
            return self.matrix @ X
        return np.asarray(self._rows[:, : self.problem.bound].T @ (self._rows @ self._all(X)))

    def settle(self, X: Floats) -> Floats:
        """All rows of X: the free ones where the cost is smallest."""
        if self._small is not None:
            return self._all(X)
        out = np.zeros((len(self._kept), X.shape[1]))
        out[self._kept] = self._all(X)
        return out

    @cached_property
    def matrix(self) -> Floats:
        """C (bound, bound)."""
        small = self._small
        moved = self._rows @ self._all(np.eye(self.problem.bound)) if small is None else small[0] @ small[1]
        return moved.T @ moved

    @cached_property
    def scale(self) -> float:
        """Mean diagonal of the constrained rows."""
        return float(self.gram.diagonal()[: self.problem.bound].mean())

    def shifted(self, less: Any, shift: float) -> Any:
        """Q - diag(less + shift I, 0): its Schur complement is C - less - shift I."""
        from scipy.sparse import block_diag, csc_array, eye_array

        bound, size = self.problem.bound, self.gram.shape[0]
        return csc_array(self.gram - block_diag([shift * eye_array(bound) + less, csc_array((size - bound,) * 2)]))

    def smallest(self, L: Multipliers, count: int = 1) -> tuple[Floats, Floats]:
        """Smallest eigenvalues of C - L (count,) and the first's eigenvector; of a large one by Lanczos on the inverse,
        around a shift that a factorisation shows to be below the spectrum."""
        from scipy.sparse.linalg import LinearOperator, eigsh

        size = self.problem.bound
        if size <= DENSE:
            values, vectors = np.linalg.eigh(self.matrix - L.dense)
            return values[:count], vectors[:, 0]
        less, shift, factored = L.matrix, -1e-7 * self.scale, None
        while factored is None:
            shift *= 10.0
            factored = cholesky_of(self.shifted(less, shift))
        zero = np.zeros(self.gram.shape[0] - size)
        whole = LinearOperator((size, size), matvec=lambda v: self.times(v.reshape(-1, 1))[:, 0] - less @ v.ravel())
        inverse = LinearOperator((size, size), matvec=lambda v: factored.solve(np.append(v, zero))[:size])
        start = np.random.default_rng(0).standard_normal(size)
        values, vectors = eigsh(whole, k=min(count, size - 1), sigma=shift, OPinv=inverse, v0=start, tol=1e-10)
        order = np.argsort(values)
        return values[order], vectors[:, order[0]]

    def lower_bound(self, L: Multipliers, count: int = 1) -> tuple[float, Floats, Floats]:
        """A cost that no point beats, for any multipliers L, rounded down by the error of C; the smallest eigenvalues
        of C - L (count,) and the first's eigenvector."""
        values, vector = self.smallest(L, count)
        error = ROUNDED * self.scale * self.problem.bound
        return 0.5 * (L.trace + self.problem.trace * min(float(values[0]), 0.0)) - error, values, vector


@dataclass(frozen=True, eq=False)
class Stationary:
    """Result of Newton's method: X (bound, p), cost, multipliers, iterations; whether the tolerance was met."""

    X: Floats
    cost: float
    multipliers: Multipliers
    iterations: int
    converged: bool


def minimise(
    reduced: Reduced,
    X: Floats,
    deadline: float = np.inf,
    tick: Callable[[], object] = lambda: None,
) -> Stationary:
    """A stationary point of 1/2 <C, X X^T> near X (bound, p), or where the time is over; Newton's steps converge
    quadratically.

    Args:
        deadline: time.perf_counter() at which to stop.
        tick: called after every step.
    """
    from scipy.sparse import eye_array, kron

    form, gram, size = reduced.problem, reduced.gram, reduced.gram.shape[0]
    system = _System(form, gram, X)
    CX = reduced.times(X)
    cost, mu, count = 0.5 * float(np.sum(X * CX)), LEAST, 0
    while True:
        L = multipliers(form, X, CX)
        gradient = np.zeros((size, X.shape[1]))
        gradient[: form.bound] = CX - L.matrix @ X
        B = tangent_basis(form, X, size)
        hessian = B.T @ kron(reduced.shifted(L.matrix, 0.0), eye_array(X.shape[1]), format="csr") @ B
        scale = (B.multiply(B).T @ np.repeat(gram.diagonal(), X.shape[1])).ravel()
        g, moved = B.T @ gradient.ravel(), False
        while not moved:
            definite = system.factor(hessian, mu * scale)
            count += 1
            tick()
            if definite:
                xi = -system.cholesky.solve(g)
                promised = 0.5 * float(mu * scale @ (xi * xi) - g @ xi)
                trial = form.project(X + (B @ xi).reshape(size, -1)[: form.bound])
                CT = reduced.times(trial)
                after = 0.5 * float(np.sum(trial * CT))
                small = promised <= PROMISE * max(cost, 1.0)
                share = 1.0 if small and after <= cost * (1.0 + 1e-12) else (cost - after) / promised
                moved = share > 0.0
                if moved:
                    X, CX, cost = trial, CT, after
                if small or mu > MOST:
                    return Stationary(X, cost, multipliers(form, X, CX), count, small)
                mu = max(mu / DECAY, LEAST) if share > 0.75 else mu if share > 0.25 else max(GROWTH * mu, FIRST)
            else:
                mu = max(GROWTH * mu, FIRST)
            if count >= MAX_ITERATIONS or mu > MOST**4 or time.perf_counter() > deadline:  # no curvature is as negative
                return Stationary(X, cost, multipliers(form, X, CX), count, False)


def tangent_basis(form: Quadratic, X: Floats, size: int) -> Any:
    """B (size p, k) of the rows (size, p), of which those beyond the constrained ones are free; orthonormal columns.

    Stiefel block (k, p): skew Omega X_B and K X_B^perp; sphere: what is orthogonal to it.
    """
    from scipy.sparse import coo_array, hstack

    p, parts = X.shape[1], []
    for tangents, rows in ((_stiefel, form.stiefel), (_sphere, form.sphere)):
        if not len(rows):
            continue
        count, k, _ = (basis := tangents(X[rows])).shape
        entries = (rows[:, :, None] * p + np.arange(p)).reshape(count, 1, -1)
        row, column = np.broadcast_arrays(entries, np.arange(count * k).reshape(count, k, 1))
        at = row.ravel(), column.ravel()
        parts.append(coo_array((basis.ravel(), at), shape=(size * p, count * k)))
    free = np.arange(form.bound * p, size * p)
    parts.append(coo_array((np.ones(len(free)), (free, np.arange(len(free)))), shape=(size * p, len(free))))
    return hstack(parts, format="csr")


def _stiefel(X: Floats) -> Floats:
    """(n, dof, k p) tangents of (n, k, p) blocks of orthonormal rows."""
    n, k, p = X.shape
    a, b = np.triu_indices(k, 1)
    skew = np.zeros((n, len(a), k, p))
    skew[:, np.arange(len(a)), a] = X[:, b] / np.sqrt(2.0)
    skew[:, np.arange(len(a)), b] = -X[:, a] / np.sqrt(2.0)
    beside = np.linalg.svd(X, full_matrices=True)[2][:, k:]
    across = np.zeros((n, k, p - k, k, p))
    across[:, np.arange(k), :, np.arange(k)] = beside
    return np.concatenate([skew.reshape(n, -1, k * p), across.reshape(n, -1, k * p)], axis=1)


def _sphere(X: Floats) -> Floats:
    """(m, q p - 1, q p) tangents of (m, q, p) blocks of unit length."""
    return np.linalg.svd(X.reshape(len(X), 1, -1), full_matrices=True)[2][:, 1:]


class _System:
    """Factors of Hessians over the tangent space, whose pattern holds whatever cancels at one point."""

    def __init__(self, form: Quadratic, gram: Any, X: Floats) -> None:
        from scipy.sparse import block_diag, csc_array, csc_matrix, kron, triu

        size, p, (n, k), (m, q) = gram.shape[0], X.shape[1], form.stiefel.shape, form.sphere.shape
        basis = abs(tangent_basis(form, X, size))
        basis.data[:] = 1.0
        blocks = Multipliers(form, np.ones((n, k, k)), np.ones(m)).matrix
        whole = abs(gram) + block_diag([blocks, csc_array((size - form.bound,) * 2)])
        self._pattern = csc_matrix(triu(basis.T @ kron(whole, np.ones((p, p)), format="csr") @ basis))
        self._pattern.sort_indices()
        count = [n, m, size - form.bound]
        group = np.repeat(np.arange(sum(count)), np.repeat([k * p - k * (k + 1) // 2, max(q * p - 1, 0), p], count))
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
