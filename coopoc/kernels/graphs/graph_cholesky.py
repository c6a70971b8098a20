"""Sparse Cholesky by supernodes: dense blocks, updated from the left by those before; and solves with the factor."""

from __future__ import annotations

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled, inside
from .graph_fronts import Fronts

PANEL = 16
"""Rows of a dense block that are eliminated at a time, and eight times as many before one product updates the rest."""
WORTH = 8000
"""Multiplications from which a call of BLAS is faster than loops."""


@compiled
def factorise(fronts: Fronts, place: Ints, values: Floats, factor: Floats) -> bool:
    """L^T of A = L L^T; False at the first pivot that is not positive.

    Args:
        fronts: of A's pattern.
        place: (K,) where each number of A's triangle belongs in the factor's numbers.
        values: (K,) the triangle.
        factor: (fronts.start[-1],) in place.

    References:
        Ng and Peyton, Block sparse Cholesky algorithms on advanced uniprocessor computers, SIAM J. Sci. Comput. 1993.
    """
    factor[:] = 0.0
    for k in range(len(place)):
        factor[place[k]] = values[k]
    count, unknowns = len(fronts.first) - 1, len(fronts.order)
    head, following, begin = np.full(count, -1), np.full(count, -1), np.zeros(count, np.int64)
    where, to = np.empty(unknowns, np.int64), np.empty(unknowns, np.int64)
    widest = int(np.diff(fronts.first).max())
    few, line = np.empty((min(widest, WORTH), min(WORTH, unknowns))), np.empty(WORTH)
    for s in range(count):
        a, c, m = shape(fronts, s)
        own = fronts.start[s]
        locate(fronts, s, where)
        d = head[s]
        while d != -1:
            later = following[d]
            _, wide, high = shape(fronts, d)
            first, last, at = begin[d], fronts.row[d + 1], fronts.start[d] + wide + begin[d] - fronts.row[d]
            middle = first
            while middle < last and fronts.rows[middle] < a + c:
                middle += 1
            p, q = middle - first, last - first
            for i in range(q):
                to[i] = where[fronts.rows[first + i]]
            if p * q * wide > WORTH:
                right = np.empty((wide, q))
                for k in range(wide):
                    right[k] = factor[at + k * high : at + k * high + q]
                product = np.dot(np.ascontiguousarray(right[:, :p].T), right)
                for j in range(p):
                    goal = own + to[j] * m
                    for i in range(j, q):
                        factor[goal + to[i]] -= product[j, i]
            else:
                for k in range(wide):
                    for i in range(q):
                        few[k, i] = factor[at + k * high + i]
                for j in range(p):
                    for i in range(j, q):
                        line[i] = 0.0
                    for k in range(wide):
                        by = few[k, j]
                        for i in range(j, q):
                            line[i] += by * few[k, i]
                    goal = own + to[j] * m
                    for i in range(j, q):
                        factor[goal + to[i]] -= line[i]
            _wait(fronts, d, middle, begin, head, following)
            d = later
        if not dense(factor[own : own + c * m].reshape(c, m)):
            return False
        _wait(fronts, s, fronts.row[s], begin, head, following)
    return True


@inside
def shape(fronts: Fronts, s: int) -> tuple[int, int, int]:
    """First column of a supernode, how many it has, and how many rows its block has in all."""
    columns = fronts.first[s + 1] - fronts.first[s]
    return fronts.first[s], columns, columns + fronts.row[s + 1] - fronts.row[s]


@inside
def locate(fronts: Fronts, s: int, where: Ints) -> None:
    """Write which row of a supernode's block each place in the order is, for those that it has."""
    a, c, _ = shape(fronts, s)
    for k in range(c):
        where[a + k] = k
    for k in range(fronts.row[s], fronts.row[s + 1]):
        where[fronts.rows[k]] = c + k - fronts.row[s]


@inside
def _wait(fronts: Fronts, d: int, k: int, begin: Ints, head: Ints, following: Ints) -> None:
    """Let supernode d update next the one that owns its row k, if it has one."""
    begin[d] = k
    if k < fronts.row[d + 1]:
        s = fronts.owner[fronts.rows[k]]
        following[d] = head[s]
        head[s] = d


@compiled
def dense(block: Floats) -> bool:
    """L^T of the first c columns of a symmetric block (c, m) in its upper triangle, in place; False as above."""
    c, m = block.shape
    for outer in range(0, c, 8 * PANEL):
        end = min(outer + 8 * PANEL, c)
        for first in range(outer, end, PANEL):
            last = min(first + PANEL, end)
            for k in range(first, last):
                if not block[k, k] > 0.0:
                    return False
                by = 1.0 / np.sqrt(block[k, k])
                for i in range(k, m):
                    block[k, i] *= by
                for j in range(k + 1, last):
                    by = block[k, j]
                    for i in range(j, m):
                        block[j, i] -= by * block[k, i]
            _downdate(block, (first, last), (last, end))
        for left in range(end, c, 8 * PANEL):
            _downdate(block, (outer, end), (left, min(left + 8 * PANEL, c)))
    return True


@compiled
def _downdate(block: Floats, done: tuple[int, int], rows: tuple[int, int]) -> None:
    """Subtract from some rows the products of those that are done, from the column of the first on."""
    if rows[0] < rows[1]:
        panel = np.ascontiguousarray(block[done[0] : done[1], rows[0] :])
        left = np.ascontiguousarray(panel[:, : rows[1] - rows[0]].T)
        block[rows[0] : rows[1], rows[0] :] -= np.dot(left, panel)


@compiled
def solved(fronts: Fronts, factor: Floats, rhs: Floats) -> Floats:
    """A^-1 rhs of (u,)."""
    x, out = rhs[fronts.order], np.empty(len(rhs))
    for s in range(len(fronts.first) - 1):
        a, c, m = shape(fronts, s)
        below = fronts.row[s] - c
        for k in range(c):
            line = fronts.start[s] + k * m
            x[a + k] /= factor[line + k]
            for i in range(k + 1, c):
                x[a + i] -= factor[line + i] * x[a + k]
            for i in range(c, m):
                x[fronts.rows[below + i]] -= factor[line + i] * x[a + k]
    for s in range(len(fronts.first) - 2, -1, -1):
        a, c, m = shape(fronts, s)
        below = fronts.row[s] - c
        for k in range(c - 1, -1, -1):
            line, total = fronts.start[s] + k * m, x[a + k]
            for i in range(k + 1, c):
                total -= factor[line + i] * x[a + i]
            for i in range(c, m):
                total -= factor[line + i] * x[fronts.rows[below + i]]
            x[a + k] = total / factor[line + k]
    for k in range(len(x)):
        out[fronts.order[k]] = x[k]
    return out


@compiled
def places(fronts: Fronts, one: Ints, other: Ints) -> Ints:
    """(K,) where pairs of places in the order, each of which the factor has a number for, stand among its numbers."""
    found = np.empty(len(one), np.int64)
    for k in range(len(one)):
        low, high = min(one[k], other[k]), max(one[k], other[k])
        s = fronts.owner[low]
        a, c, m = shape(fronts, s)
        along = high - a
        if along >= c:
            along = c + np.searchsorted(fronts.rows[fronts.row[s] : fronts.row[s + 1]], high)
        found[k] = fronts.start[s] + (low - a) * m + along
    return found
