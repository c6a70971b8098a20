"""The cost of the constrained rows alone: the free positions of a QCQP eliminated, densely or sparsely.

1/2 |A X|^2 is smallest over the free rows at X_f = -Q_ff^+ Q_fc X_c, Q = A^T A, and is then 1/2 <C, X_c X_c^T> with
C = Q_cc - Q_cf Q_ff^+ Q_fc. Whatever block-diagonal L is subtracted, C - L is the Schur complement of Q - diag(L, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ...arrays import Bools, Floats
from ..algebra.cholesky import cholesky_of
from .qcqp import Multipliers, Quadratic

DENSE = 500
"""Up to this many constrained rows C is formed."""


class Reduced(Protocol):
    """Data of the solvers on the constrained rows."""

    def times(self, X: Floats) -> Floats:
        """C X."""

    def settle(self, X: Floats) -> Floats:
        """All rows of X: the free ones where the cost is smallest."""

    def smallest(self, L: Multipliers) -> tuple[float, Floats]:
        """Smallest eigenvalue of C - L and its eigenvector."""

    def precondition(self, V: Floats) -> Floats:
        """Approximately C^-1 V."""


def reduce(problem: Quadratic) -> Reduced:
    """Dense where that is cheap, else sparse."""
    return Dense(problem) if problem.bound <= DENSE else Sparse(problem)


@dataclass(frozen=True, eq=False)
class Dense:
    """C as an array."""

    problem: Quadratic

    @cached_property
    def _free(self) -> Floats:
        rows = self.problem.rows.toarray()
        moved: Floats = -np.linalg.lstsq(rows[:, self.problem.bound :], rows[:, : self.problem.bound], rcond=None)[0]
        return moved

    @cached_property
    def matrix(self) -> Floats:
        """C."""
        rest = self.problem.rows @ np.concatenate([np.eye(self.problem.bound), self._free])
        return np.asarray(rest.T @ rest)

    def times(self, X: Floats) -> Floats:
        """C X."""
        return np.asarray(self.matrix @ X)

    def settle(self, X: Floats) -> Floats:
        """All rows of X."""
        return np.concatenate([X, self._free @ X])

    def smallest(self, L: Multipliers) -> tuple[float, Floats]:
        """Of C - L."""
        values, vectors = np.linalg.eigh(self.matrix - L.dense)
        return float(values[0]), vectors[:, 0]

    @cached_property
    def _inverse(self) -> Floats:
        size = len(self.matrix)
        return np.linalg.inv(self.matrix + RIDGE * max(np.trace(self.matrix) / size, 1e-300) * np.eye(size))

    def precondition(self, V: Floats) -> Floats:
        """(C + ridge)^-1 V."""
        return np.asarray(self._inverse @ V)


RIDGE = 1e-6
"""Of the mean diagonal, in the preconditioner."""


@dataclass(frozen=True, eq=False)
class Sparse:
    """C through sparse factorisations of Q."""

    problem: Quadratic

    @cached_property
    def _kept(self) -> Bools:
        """False for the first position of each part that could be moved as a whole: it is fixed at zero."""
        from scipy.sparse import csc_array
        from scipy.sparse.csgraph import connected_components

        bound, free = self.problem.bound, self.problem.rows[:, self.problem.bound :].tocsc()
        count, label = connected_components(free.T @ free, directed=False)
        whole = csc_array((np.ones(len(label)), (np.arange(len(label)), label)), shape=(len(label), count))
        moved, all_of_it = (
            np.asarray(abs(part).max(axis=0).todense()).ravel() for part in (free @ whole, abs(free) @ whole)
        )
        _, first = np.unique(label, return_index=True)
        kept = np.ones(self.problem.rows.shape[1], dtype=bool)
        kept[bound + first[moved <= 1e-9 * all_of_it]] = False
        return kept

    @cached_property
    def gram(self) -> Any:
        rows = self.problem.rows[:, self._kept]
        return (rows.T @ rows).tocsc()

    @cached_property
    def _inverse(self) -> Any:
        return factorise(self.gram[self.problem.bound :, self.problem.bound :])

    @cached_property
    def _parts(self) -> tuple[Any, Any]:
        """Q_cc and Q_fc."""
        bound = self.problem.bound
        return self.gram[:bound, :bound].tocsr(), self.gram[bound:, :bound].tocsr()

    def _free(self, X: Floats) -> Floats:
        return np.asarray(-self._inverse.solve(self._parts[1] @ X))

    def times(self, X: Floats) -> Floats:
        """C X."""
        own, cross = self._parts
        return np.asarray(own @ X + cross.T @ self._free(X))

    def settle(self, X: Floats) -> Floats:
        """All rows of X."""
        out = np.zeros((len(self._kept), X.shape[1]))
        out[self._kept] = np.concatenate([X, self._free(X)])
        return out

    @cached_property
    def scale(self) -> float:
        """Mean diagonal of the constrained rows."""
        return float(self.gram.diagonal()[: self.problem.bound].mean())

    @cached_property
    def _ridged(self) -> Any:
        return factorise(self.shifted(None, -RIDGE * self.scale))

    def precondition(self, V: Floats) -> Floats:
        """(C + ridge)^-1 V."""
        return self._solve(self._ridged, V)

    def _solve(self, factored: Any, V: Floats) -> Floats:
        full = np.concatenate([V, np.zeros((self.gram.shape[0] - len(V), *V.shape[1:]))])
        return np.asarray(factored.solve(full)[: len(V)])

    def shifted(self, less: Any, shift: float) -> Any:
        """Q - diag(less + shift I, 0): its Schur complement is C - less - shift I."""
        from scipy.sparse import block_diag, csc_array, eye_array

        bound, size = self.problem.bound, self.gram.shape[0]
        corner = shift * eye_array(bound) + (0 if less is None else less)
        return csc_array(self.gram - block_diag([corner, csc_array((size - bound, size - bound))]))

    def smallest(self, L: Multipliers) -> tuple[float, Floats]:
        """Of C - L: Lanczos on the inverse around a shift that a factorisation shows to be below the spectrum."""
        from scipy.sparse.linalg import LinearOperator, eigsh

        less, shift, factored = L.sparse, -1e-7 * self.scale, None
        while factored is None:
            shift *= 10.0
            factored = cholesky_of(self.shifted(less, shift))
        size = self.problem.bound
        whole = LinearOperator((size, size), matvec=lambda v: self.times(v.reshape(-1, 1))[:, 0] - less @ v.ravel())
        inverse = LinearOperator((size, size), matvec=lambda v: self._solve(factored, v.ravel()))
        start = np.random.default_rng(0).standard_normal(size)
        value, vector = eigsh(whole, k=1, sigma=shift, OPinv=inverse, v0=start, tol=1e-10)
        return float(value[0]), vector[:, 0]


def lower_bound(reduced: Reduced, L: Multipliers) -> tuple[float, float, Floats]:
    """A cost that no point beats, for any multipliers L; the smallest eigenvalue of C - L and its eigenvector."""
    smallest, vector = reduced.smallest(L)
    return 0.5 * (L.trace + L.problem.trace * min(smallest, 0.0)), smallest, vector


def factorise(matrix: Any) -> Any:
    """Sparse L D L^T of a symmetric matrix by SuperLU, diagonal pivots as long as they serve."""
    from scipy.sparse.linalg import splu

    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
