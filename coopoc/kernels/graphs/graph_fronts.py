"""Where the Cholesky factor of a sparse matrix has numbers: columns of equal structure as dense blocks (supernodes)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled

RELAXED = ((12, 0.5), (1 << 30, 0.02))
"""Columns up to which blocks are joined if at most this share of the result is zeros."""


class Fronts(NamedTuple):
    """Supernodes s = 0, 1, ... in the order of elimination, each a block of c columns and m = c + r rows of the factor.

    Attributes:
        order: (u,) unknown that is eliminated as the k-th.
        first: (S + 1,) first column of each.
        row: (S + 1,) place in `rows` of the first row below its columns.
        rows: (R,) those rows, ascending, as places in the order.
        start: (S + 1,) place in the factor's numbers of its block, m rows of c.
        owner: (u,) supernode of each column.
    """

    order: Ints
    first: Ints
    row: Ints
    rows: Ints
    start: Ints
    owner: Ints


@compiled
def elimination_tree(indptr: Ints, indices: Ints, order: Ints) -> tuple[Ints, Ints]:
    """A postorder of the elimination tree of a symmetric pattern (n), and each column's parent in it, -1 for a root.

    Args:
        indptr: (n + 1,) of the whole pattern; the diagonal counts for nothing.
        indices: of its neighbours.
        order: (n,) which is eliminated as the k-th.

    References:
        Liu, The role of elimination trees in sparse factorization, SIAM J. Matrix Anal. 1990.
    """
    n = len(order)
    place, parent, ancestor = np.empty(n, np.int64), np.full(n, -1), np.full(n, -1)
    for k in range(n):
        place[order[k]] = k
    for k in range(n):
        for e in range(indptr[order[k]], indptr[order[k] + 1]):
            i = place[indices[e]]
            while i != -1 and i < k:
                above = ancestor[i]
                ancestor[i] = k
                if above == -1:
                    parent[i] = k
                i = above
    head, sibling, stack = np.full(n + 1, -1), np.full(n, -1), np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):  # roots hang on n, which index -1 means
        sibling[k] = head[parent[k]]
        head[parent[k]] = k
    renamed, found, depth = np.empty(n, np.int64), 0, 0
    post = np.empty(n, np.int64)
    root = head[n]
    while root != -1:
        stack[0], depth = root, 1
        while depth > 0:
            k = stack[depth - 1]
            child = head[k]
            if child != -1:
                head[k] = sibling[child]
                stack[depth] = child
                depth += 1
            else:
                depth -= 1
                renamed[k] = found
                post[found] = k
                found += 1
        root = sibling[root]
    above_ = np.full(n, -1)
    for k in range(n):
        if parent[post[k]] != -1:
            above_[k] = renamed[parent[post[k]]]
    return order[post], above_


@compiled
def structures(indptr: Ints, indices: Ints, order: Ints, parent: Ints) -> tuple[Ints, Ints]:
    """Rows below the diagonal of each column of the factor, unsorted: place of the first (n + 1,), and the rows.

    A column has the rows of its matrix and those of its children in the tree; arguments as in `elimination_tree`.
    """
    n = len(order)
    place, seen, begin = np.empty(n, np.int64), np.full(n, -1), np.zeros(n + 1, np.int64)
    head, sibling = np.full(n, -1), np.full(n, -1)
    for k in range(n):
        place[order[k]] = k
    rows, count = np.empty(len(indices) + n, np.int64), 0
    for k in range(n):
        seen[k] = k
        if count + n > len(rows):
            wider = np.empty(2 * len(rows) + n, np.int64)
            wider[:count] = rows[:count]
            rows = wider
        for e in range(indptr[order[k]], indptr[order[k] + 1]):
            i = place[indices[e]]
            if i > k and seen[i] != k:
                seen[i], rows[count] = k, i
                count += 1
        child = head[k]
        while child != -1:
            for e in range(begin[child], begin[child + 1]):
                i = rows[e]
                if seen[i] != k:
                    seen[i], rows[count] = k, i
                    count += 1
            child = sibling[child]
        begin[k + 1] = count
        if parent[k] != -1:
            sibling[k] = head[parent[k]]
            head[parent[k]] = k
    return begin, rows[:count]


@compiled
def supernodes(parent: Ints, begin: Ints, rows: Ints, width: Ints, relaxed: Floats) -> Ints:
    """First column of each supernode, and n: a column joins its last child where that adds few zeros.

    Args:
        parent: (n,) in the tree.
        begin: (n + 1,) and rows: of `structures`.
        width: (n,) unknowns of each column.
        relaxed: RELAXED as an array (K, 2).
    """
    n = len(parent)
    found, count = np.empty(n + 1, np.int64), 0
    wide, zeros, below_last = 0, 0.0, 0
    for k in range(n):
        below = 0
        for e in range(begin[k], begin[k + 1]):
            below += width[rows[e]]
        joined = False
        if k > 0 and parent[k - 1] == k:
            more = zeros + wide * (width[k] + below - below_last)
            whole = wide + width[k]
            size = 0.5 * whole * (whole + 1) + whole * below
            for a in range(len(relaxed)):
                if whole <= relaxed[a, 0]:
                    joined = more <= relaxed[a, 1] * size
                    break
            if joined:
                wide, zeros = whole, more
        if not joined:
            found[count] = k
            count += 1
            wide, zeros = width[k], 0.0
        below_last = below
    found[count] = n
    return found[: count + 1]
