"""A QCQP's constrained rows, its free positions eliminated, and the bound that multipliers of them prove.

1/2 |A X|^2 is smallest over the free rows at X_f = -Q_ff^-1 Q_fc X_c, Q = A^T A, and is then 1/2 <C, X_c X_c^T> with
C = Q_cc - Q_cf Q_ff^-1 Q_fc. Whatever block-diagonal L is subtracted, C - L is the Schur complement of Q - diag(L, 0).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import Bools, Floats
from ..algebra.cholesky import Cholesky, cholesky_of, columns_solved
from .qcqp import Multipliers, Quadratic

FORMED_ROWS = 500
"""Up to this many constrained rows C is formed."""
ROUNDED = 2.0**-51
"""Share of the diagonal of Q by which C may be off: at most 0.84 of 2^-52 where fractions give the cost."""


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
        factor = cholesky_of(self.gram[self.problem.bound :, self.problem.bound :])
        assert factor is not None  # what could be moved as a whole is not among the rows
        return factor

    def _all(self, X: Floats) -> Floats:
        """The constrained rows X and the free ones where the cost is smallest."""
        bound = self.problem.bound
        right = -(self._rows[:, bound:].T @ (self._rows[:, :bound] @ X))
        return np.concatenate([X, columns_solved(self._inverse, right)])

    def times(self, X: Floats) -> Floats:
        """C X."""
        if self.problem.bound <= FORMED_ROWS:
            return self.matrix @ X
        return np.asarray(self._rows[:, : self.problem.bound].T @ (self._rows @ self._all(X)))

    def settle(self, X: Floats) -> Floats:
        """All rows of X: the free ones where the cost is smallest."""
        out = np.zeros((len(self._kept), X.shape[1]))
        out[self._kept] = self._all(X)
        return out

    @cached_property
    def matrix(self) -> Floats:
        """C (bound, bound)."""
        moved = self._rows @ self._all(np.eye(self.problem.bound))
        return np.asarray(moved.T @ moved)

    @cached_property
    def scale(self) -> float:
        """Mean diagonal of the constrained rows."""
        return float(self.gram.diagonal()[: self.problem.bound].mean())

    def smallest(self, L: Multipliers, count: int = 1) -> Floats:
        """Smallest eigenvalues of C - L (count,); of a large one by Lanczos on the inverse, around a shift that a
        factorisation shows to be below the spectrum."""
        from scipy.sparse import block_diag, eye_array
        from scipy.sparse.linalg import LinearOperator, eigsh

        size = self.problem.bound
        if size <= FORMED_ROWS:
            return np.linalg.eigvalsh(self.matrix - L.matrix.toarray())[:count]
        less, shift, factored, rest = L.matrix, -1e-7 * self.scale, None, self.gram.shape[0] - size
        while factored is None:  # the Schur complement of this matrix is C - less - shift I
            shift *= 10.0
            moved = block_diag([shift * eye_array(size) + less, 0.0 * eye_array(rest)])
            factored = cholesky_of((self.gram - moved).tocsc())
        zero = np.zeros(rest)
        whole = LinearOperator((size, size), matvec=lambda v: self.times(v.reshape(-1, 1))[:, 0] - less @ v.ravel())
        inverse = LinearOperator((size, size), matvec=lambda v: factored.solve(np.append(v, zero))[:size])
        start = np.random.default_rng(0).standard_normal(size)
        options = {"sigma": shift, "OPinv": inverse, "v0": start, "tol": 1e-10, "return_eigenvectors": False}
        return np.sort(eigsh(whole, k=min(count, size - 1), **options))

    def lower_bound(self, L: Multipliers, count: int = 1) -> tuple[float, Floats]:
        """A cost that no point beats, for any multipliers L, rounded down by the error of C; the smallest eigenvalues
        of C - L (count,)."""
        values = self.smallest(L, count)
        error = ROUNDED * self.scale * self.problem.bound
        return 0.5 * (L.trace + self.problem.trace * min(float(values[0]), 0.0)) - error, values
