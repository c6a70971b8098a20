"""The sparse Cholesky factor against NumPy's dense one: solves, definiteness, entries of the inverse."""

import numpy as np
import pytest
from numpy import arange
from numpy.linalg import eigvalsh, inv, solve
from numpy.random import default_rng
from scipy.sparse import csc_matrix, triu
from threadpoolctl import threadpool_info, threadpool_limits

from coopoc.kernels.graphs import multifrontal
from coopoc.kernels.graphs.multifrontal import supernodes
from coopoc.optimize.algebra.cholesky import Cholesky
from coopoc.workers import one_thread


def graph_matrix(seed, nodes, pairs, width):
    """J^T J of a chain of nodes and of random pairs, each with a full block of rows; a prior on the first."""
    rng = default_rng(seed)
    k = arange(nodes - 1)
    ends = np.concatenate([np.c_[k, k + 1], rng.integers(0, nodes, (pairs, 2))])
    J = np.zeros((len(ends) + 1, width, nodes, width))
    J[arange(len(ends)), :, ends[:, 0]] = rng.normal(size=(len(ends), width, width))
    J[arange(len(ends)), :, ends[:, 1]] += rng.normal(size=(len(ends), width, width))
    J[-1, :, 0] = np.eye(width)
    whole = J.reshape(-1, nodes * width)
    return whole.T @ whole


def upper(matrix):
    found = csc_matrix(triu(csc_matrix(matrix)))
    found.sort_indices()
    return found


@pytest.mark.parametrize(
    ("nodes", "pairs", "width"),
    [(1, 0, 3), (2, 0, 1), (40, 5, 3), (60, 30, 6), (90, 900, 2), (200, 600, 3), (150, 600, 6)],
)
def test_it_solves_and_inverts_as_numpy_does(nodes, pairs, width):
    """The last three fill in nearly everywhere, so that blocks of hundreds of columns take the way of BLAS, and of the
    last METIS is asked for an order."""
    A = graph_matrix(nodes + pairs, nodes, pairs, width)
    pattern = upper(A)
    cholesky = Cholesky(pattern.indptr, pattern.indices, np.repeat(arange(nodes), width))
    for scale in (1.0, 3.0):  # the second factorisation uses the analysis of the first
        assert cholesky.factor(upper(scale * A).data)
        rhs = default_rng(1).normal(size=len(A))
        assert cholesky.solve(rhs) == pytest.approx(solve(scale * A, rhs), rel=1e-6, abs=1e-8)
        rows, columns = np.nonzero(A)
        assert cholesky.inverse(rows, columns) == pytest.approx(inv(scale * A)[rows, columns], rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("pairs", [3, 900])
def test_a_matrix_that_curves_downwards_is_refused(pairs):
    """The smallest eigenvalue is NumPy's; slightly above it the shifted matrix is indefinite, slightly below not."""
    A = graph_matrix(pairs, 90, pairs, 2)
    least = eigvalsh(A)[0]
    cholesky = Cholesky(upper(A).indptr, upper(A).indices)
    for share, definite in ((0.99, True), (1.01, False), (0.5, True)):
        assert cholesky.factor(upper(A - share * least * np.eye(len(A))).data) is definite


def test_parts_that_nothing_joins_are_factored_apart():
    A = np.zeros((30, 30))
    A[:12, :12], A[12:, 12:] = graph_matrix(7, 4, 2, 3), graph_matrix(8, 6, 1, 3)
    order = default_rng(0).permutation(30)
    pattern, rhs = upper(A[np.ix_(order, order)]), arange(30.0)
    cholesky = Cholesky(pattern.indptr, pattern.indices)
    assert cholesky.factor(pattern.data)
    assert cholesky.solve(rhs) == pytest.approx(solve(A[np.ix_(order, order)], rhs), rel=1e-8)


def test_a_chain_is_cut_where_half_of_a_block_would_be_zeros():
    """w columns of a chain hold 2 w numbers in a block of w (w + 3) / 2: at w = 5 half of it is zeros."""
    n = 20
    parent, begin, rows = arange(1, n + 1), np.r_[arange(n), n - 1], arange(1, n)
    parent[-1] = -1
    assert supernodes(parent, begin, rows, np.ones(n, int)).tolist() == [0, 5, 10, 15, 20]


def test_small_matrices_are_factored_by_one_thread(monkeypatch):
    """Of two cores that share 150 rows each waits for the other, a hundred times as long as one alone takes."""
    threads, whole = set[int](), multifrontal.factorise

    def counted(*arguments):
        threads.update(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")
        return whole(*arguments)

    monkeypatch.setattr(multifrontal, "factorise", counted)
    with threadpool_limits(2):
        assert Cholesky(arange(151), arange(150)).factor(np.ones(150))
    assert threads == {1}


def test_contexts_of_one_thread_that_overlap_restore_the_threads():
    """Of two threads the first to enter may be the first to leave; one thread was left for good."""
    with threadpool_limits(2):
        first, second = one_thread(), one_thread()
        for context in (first, second):
            context.__enter__()
        for context in (first, second):
            context.__exit__(None, None, None)
        assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == {2}
