"""Sparse Cholesky factors of a Hessian with their analysis kept: solve, definiteness, marginals of any unknowns."""

from contextlib import nullcontext
from functools import lru_cache
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from ...workers import one_thread

THREADED_UNKNOWNS = 64
"""Unknowns from which BLAS shares matrices among threads."""
DISSECTED_WORK, DISSECTED_NODES = 50_000, 2000
"""Multiplications per node, of so many nodes at least, from which nested dissection is tried beside minimum degree: it
takes as long as they do in a few factorisations."""


def _unshared(size: int) -> Any:
    return one_thread() if size > THREADED_UNKNOWNS else nullcontext()


class Cholesky:
    """A = L L^T of matrices of one pattern; ordering and structure are found once.

    `factor` before all else; what is asked is of the matrix that was factored last.

    Args:
        indptr: (u + 1,) of the upper triangle, CSC with sorted rows and no diagonal left out.
        indices: of its rows.
        group: (u,) ascending, the node of each unknown. None: each is alone.

    >>> cholesky = Cholesky(np.array([0, 1, 3]), np.array([0, 0, 1]))
    >>> cholesky.factor(np.array([2.0, 1.0, 2.0])), cholesky.solve(np.array([3.0, 3.0])).round(6)
    (True, array([1., 1.]))
    """

    def __init__(self, indptr: Ints, indices: Ints, group: Ints | None = None) -> None:
        from ...kernels.graphs import multifrontal

        self._kernels = multifrontal  # to import it again at each call takes as long as to factor a star
        size = len(indptr) - 1
        pattern = indptr, indices, np.arange(size) if group is None else group
        self._fronts = analysed(*(part.astype(int).tobytes() for part in pattern))
        self._rank = np.argsort(self._fronts.order)
        column = np.repeat(np.arange(size), np.diff(indptr))
        self._place = multifrontal.places(self._fronts, self._rank[indices], self._rank[column])
        self._factor = np.empty(int(self._fronts.start[-1]))

    def factor(self, values: Floats) -> bool:
        """Factor an upper triangle's values; whether it is positive definite."""
        with _unshared(len(self._rank)):
            return not len(values) or bool(self._kernels.factorise(self._fronts, self._place, values, self._factor))

    @property
    def pivots(self) -> Floats:
        """(u,) squares of L's diagonal."""
        return np.square(self._factor[self._kernels.places(self._fronts, self._rank, self._rank)])

    def solve(self, rhs: Floats) -> Floats:
        """A^-1 rhs, (u,) or (u, K), column by column."""
        if rhs.ndim == 2:
            return np.column_stack([*map(self.solve, rhs.T.copy())])
        return self._kernels.solved(self._fronts, self._factor, rhs)

    def inverse(self, rows: Ints, columns: Ints) -> Floats:
        """A^-1 at pairs of unknowns (K,), each of which A has an entry for.

        See `selected_inverse`; time and memory are those of the factor, not of the inverse.
        """
        with _unshared(len(self._rank)):
            inverse = self._kernels.selected_inverse(self._fronts, self._factor)
        return inverse[self._kernels.places(self._fronts, self._rank[rows], self._rank[columns])]


def cholesky_of(matrix: Any, group: Ints | None = None) -> Cholesky | None:
    """Factors of a sparse symmetric matrix (SciPy's, any format), or None: it is not positive definite. The group is
    that of `Cholesky`.

    >>> from scipy.sparse import csc_array
    >>> cholesky_of(csc_array([[2.0, 1.0], [1.0, 2.0]])).solve(np.array([3.0, 3.0])).round(6)
    array([1., 1.])
    >>> cholesky_of(csc_array([[1.0, 2.0], [2.0, 1.0]])) is None
    True
    """
    from scipy.sparse import triu

    upper = triu(matrix, format="csc")
    upper.sort_indices()
    if not (np.isfinite(upper.data).all() and (upper.diagonal() > 0).all()):
        return None
    cholesky = Cholesky(upper.indptr, upper.indices, group)
    return cholesky if cholesky.factor(upper.data) else None


@lru_cache(maxsize=3)
def analysed(*pattern: bytes) -> Any:
    """Fronts of a pattern of whole numbers (indptr, indices, group), its groups of unknowns in the order of approximate
    minimum degree or of nested dissection; the last ones are kept, as rotations and positions are averaged alike.

    References:
        Amestoy, Davis, Duff, An approximate minimum degree ordering algorithm, SIAM J. Matrix Anal. 1996; Karypis,
        Kumar, A fast and high quality multilevel scheme for partitioning irregular graphs, SIAM J. Sci. Comput. 1998.
    """
    from scipy.sparse import csc_array, csr_array

    from ...kernels.graphs.multifrontal import Fronts, postorder, supernodes

    indptr, indices, group = (np.frombuffer(part, int) for part in pattern)
    _, begin, width = np.unique(group, return_index=True, return_counts=True)
    u, n = len(group), len(width)
    of = csr_array((np.ones(u), np.repeat(np.arange(n), width), np.arange(u + 1)), shape=(u, n))
    upper = of.T @ csc_array((np.ones(len(indices)), indices, indptr), shape=(u, u)) @ of
    order, lower = eliminated((upper + upper.T).tocsc(), u / max(n, 1))
    later = postorder(_parents(lower), np.diff(lower.indptr).astype(int))
    order, lower = order[later], lower[later][:, later]
    lower.sort_indices()
    begin, width = begin[order], width[order]
    head = supernodes(_parents(lower), lower.indptr.astype(int), lower.indices.astype(int), width)
    first, below = np.append(0, np.cumsum(width)), lower[head[1:] - 1]
    rows, columns = below.indices, np.diff(first[head])
    row = np.append(0, np.cumsum(width[rows]))[below.indptr]
    return Fronts(
        _runs(begin, width),
        first[head],
        row,
        _runs(first[rows], width[rows]),
        np.append(0, np.cumsum(columns * (columns + np.diff(row)))),
        np.repeat(np.arange(len(columns)), columns),
    )


def eliminated(pattern: Any, unknowns: float) -> tuple[Ints, Any]:
    """The order (n,) in which nodes of a symmetric pattern, of so many `unknowns`, are eliminated, and L's below the
    diagonal in that order, CSR of its transpose: the rows of each column, ascending, the first of which is its parent
    in the elimination tree."""
    found = _filled(pattern, True)
    if _work(found) * unknowns**3 > DISSECTED_WORK * max(pattern.shape[0], DISSECTED_NODES):
        order = _dissected(pattern)
        found = min(found, (order, _filled(pattern[order][:, order].sorted_indices(), False)[1]), key=_work)
    return found


def _filled(pattern: Any, by_degree: bool) -> tuple[Ints, Any]:
    """Order and L of `eliminated`, by CasADi's AMD or as the nodes come."""
    import casadi as ca
    from scipy.sparse import csc_array

    n = pattern.shape[0]
    upper, order = ca.Sparsity(n, n, pattern.indptr.tolist(), pattern.indices.tolist()).ldl(by_degree)
    indptr, indices = upper.get_ccs()
    return np.array(order, int), csc_array((np.ones(len(indices)), indices, indptr), shape=(n, n)).tocsr()


def _work(found: tuple[Ints, Any]) -> float:
    """Multiplications of a factorisation with one unknown per node."""
    return float(np.square(np.diff(found[1].indptr) + 1.0).sum())


def _dissected(pattern: Any) -> Ints:
    """(n,) nodes in the order of METIS, which GTSAM has; last those alone, with which it writes beyond its memory."""
    from gtsam import Ordering, SymbolicFactorGraph
    from scipy.sparse import triu

    graph, pairs = SymbolicFactorGraph(), triu(pattern, 1).tocoo()
    for pair in zip(pairs.row.tolist(), pairs.col.tolist(), strict=True):
        graph.push_factor(*pair)
    found = Ordering.MetisSymbolicFactorGraph(graph)
    order = [found.at(k) for k in range(found.size())]
    return np.append(order, np.setdiff1d(np.arange(pattern.shape[0]), order)).astype(int)


def _parents(lower: Any) -> Ints:
    """(n,) the first row of each column, -1 if there is none."""
    return np.where(np.diff(lower.indptr) > 0, np.append(lower.indices, -1)[lower.indptr[:-1]], -1).astype(int)


def _runs(first: Ints, length: Ints) -> Ints:
    """first[k], first[k] + 1, ... of each length[k]."""
    return np.asarray(np.arange(length.sum()) + np.repeat(first + length - np.cumsum(length), length))
