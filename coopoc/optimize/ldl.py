"""Sparse L D L^T of a Hessian with its analysis kept: solve, definiteness, and marginals by selected inversion."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import Floats, Ints


class LDL:
    """P^T A P = (I + L) D (I + L)^T of matrices of one pattern, by qdldl; the ordering is found once.

    `factor` before all else; what is asked is of the matrix that was factored last.

    >>> from scipy.sparse import csc_matrix
    >>> ldl = LDL()
    >>> ldl.factor(csc_matrix(np.triu([[2.0, 1.0], [1.0, 2.0]]))), ldl.solve(np.array([3.0, 3.0])).round(6)
    (True, array([1., 1.]))
    """

    def __init__(self) -> None:
        self._solver: Any = None
        self._parts: Any = None

    def factor(self, upper: Any) -> bool:
        """Factor an upper triangle (CSC, rows sorted, the diagonal last and never left out); whether it is positive
        definite."""
        import qdldl

        self._parts = None
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(upper, upper=True)
            else:
                self._solver.update(upper, upper=True)
        except RuntimeError:  # a pivot of exactly zero at the first analysis
            self._solver = None
            return False
        self._parts = self._solver.factors()
        return bool((self._parts[1] > 0).all())

    def solve(self, rhs: Floats) -> Floats:
        """(m,) A^-1 rhs."""
        return np.asarray(self._solver.solve(rhs))

    def inverse(self, rows: Ints, columns: Ints) -> Floats:
        """A^-1 at pairs of unknowns (K,), each of which A has an entry for.

        See `selected_inverse`; time and memory are those of the factor, not of the inverse.
        """
        from ..kernels.graph_inverse import selected_inverse

        L, diagonal, order = self._parts
        indptr, indices = L.indptr.astype(np.int64), L.indices.astype(np.int64)
        inverse, own = selected_inverse(indptr, indices, L.data, diagonal)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        one, other = place[rows], place[columns]
        low, high = np.minimum(one, other), np.maximum(one, other)
        count = len(order)
        key = np.repeat(np.arange(count), np.diff(indptr)) * count + indices
        at = np.minimum(np.searchsorted(key, low * count + high), max(len(key) - 1, 0))
        if not len(key):
            return np.where(low == high, own[low], 0.0)
        return np.where(low == high, own[low], inverse[at])
