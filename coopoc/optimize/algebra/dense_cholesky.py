"""Cholesky factors of one small matrix after the other, by LAPACK: the interface is that of `Cholesky`."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats, Ints


class DenseCholesky:
    """A = U^T U of matrices of one pattern.

    Args:
        indptr: (u + 1,) of the upper triangle, CSC.
        indices: of its rows.

    >>> cholesky = DenseCholesky(np.array([0, 1, 3]), np.array([0, 0, 1]))
    >>> cholesky.factor(np.array([2.0, 1.0, 2.0])), cholesky.solve(np.array([3.0, 3.0])).round(6)
    (True, array([1., 1.]))
    """

    def __init__(self, indptr: Ints, indices: Ints) -> None:
        from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

        self._dpotrf, self._dpotri, self._dpotrs = dpotrf, dpotri, dpotrs
        self._size = len(indptr) - 1
        self._place = np.asarray(indices) + self._size * np.repeat(np.arange(self._size), np.diff(indptr))

    def factor(self, values: Floats) -> bool:
        """Factor an upper triangle's values; whether it is positive definite."""
        if not self._size:
            return True
        matrix = np.zeros(self._size**2)
        matrix[self._place] = values
        self._root, info = self._dpotrf(matrix.reshape(self._size, -1).T, clean=0, overwrite_a=1)
        return bool(info == 0)

    def solve(self, rhs: Floats) -> Floats:
        """(u,) A^-1 rhs."""
        return np.asarray(self._dpotrs(self._root, rhs)[0]) if self._size else rhs

    def inverse(self, rows: Ints, columns: Ints) -> Floats:
        """A^-1 at pairs of unknowns (K,)."""
        if not self._size:
            return np.zeros(len(rows))
        whole = self._dpotri(self._root)[0]
        return np.asarray(whole[np.minimum(rows, columns), np.maximum(rows, columns)])
