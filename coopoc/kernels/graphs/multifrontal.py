"""Multifrontal sparse Cholesky of a symmetric matrix: factorisation, solves and the selected inverse.

Columns of nearly equal structure are a supernode, whose front is the dense matrix of its columns and of the rows below
them: it adds up what the matrix and its children say of them, eliminates the columns, and hands the rest to its parent.
In a postorder what waits for a parent is a stack of upper triangles.

References:
    Duff and Reid, The multifrontal solution of indefinite sparse symmetric linear equations, ACM TOMS 1983; Liu, The
    multifrontal method for sparse matrix solution, SIAM Review 1992.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ..compiling.compile import compiled, inside

PANEL = 16
"""Rows of a front that are eliminated before one product updates the others of their block."""
BLOCK = 128
"""Rows of a block, after which one product updates the rest: wide enough for BLAS to be fast."""
WORTH = 200_000
"""Multiplications from which a call of BLAS is faster than our loops."""
STRIP = 64
"""Rows that one product updates: below the diagonal it would compute what nothing reads."""


class Fronts(NamedTuple):
    """Supernodes s = 0, 1, ... in the order of elimination, each a block of c columns and m = c + r rows of the factor.

    Attributes:
        order: (u,) unknown that is eliminated as the k-th.
        first: (S + 1,) first column of each.
        row: (S + 1,) index in `rows` of the first row below its columns.
        rows: (R,) those rows, ascending, by their index in the order.
        start: (S + 1,) index in the factor's numbers of its block, m rows of c.
        owner: (u,) supernode of each column.
    """

    order: Ints
    first: Ints
    row: Ints
    rows: Ints
    start: Ints
    owner: Ints


@compiled
def postorder(parent: Ints, size: Ints) -> Ints:
    """(n,) columns of a tree, each after its subtree, which is in one piece, and after the largest of its children.

    Columns that follow their only large child can join it.

    Args:
        parent: (n,) in the tree, -1 for a root.
        size: (n,) rows of each.
    """
    n, at, count = len(parent), len(parent), 0
    head, sibling = np.full(n + 1, -1), np.full(n + 1, -1)
    stack, out = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in np.argsort(-size):
        sibling[k], head[parent[k]] = head[parent[k]], k
    k = head[-1]
    while k != -1 or count:
        while k != -1:
            stack[count], k = k, sibling[k]
            count += 1
        count, at = count - 1, at - 1
        out[at] = stack[count]
        k = head[out[at]]
    return out


@compiled
def supernodes(parent: Ints, begin: Ints, rows: Ints, width: Ints) -> Ints:
    """First column of each supernode, and n: a column joins its last child where that adds few zeros.

    Up to 12 unknowns half of a front may be zeros, beyond that a fiftieth.

    Args:
        parent: (n,) in the tree.
        begin: (n + 1,) index in `rows` of the first row of each column.
        rows: below the diagonal.
        width: (n,) unknowns of each column.
    """
    n = len(parent)
    heads, count = np.empty(n + 1, np.int64), 0
    wide, zeros, below_last = 0, 0.0, 0
    for k in range(n):
        below = width[rows[begin[k] : begin[k + 1]]].sum()
        more, whole = zeros + wide * (width[k] + below - below_last), wide + width[k]
        most = min(0.5, 0.03 + 8.0 / whole) * whole * (0.5 * (whole + 1) + below)
        if k > 0 and parent[k - 1] == k and more <= most:
            wide, zeros = whole, more
        else:
            heads[count], wide, zeros = k, width[k], 0.0
            count += 1
        below_last = below
    heads[count] = n
    return heads[: count + 1]


@inside
def shape(fronts: Fronts, s: int) -> tuple[int, int, int]:
    """First column of a supernode, how many it has, and how many rows its front has in all."""
    columns = fronts.first[s + 1] - fronts.first[s]
    return fronts.first[s], columns, columns + fronts.row[s + 1] - fronts.row[s]


@inside
def locate(fronts: Fronts, s: int, where: Ints) -> None:
    """Write which row of a supernode's front each index in the order is, for those that it has."""
    a, c, _ = shape(fronts, s)
    for k in range(c):
        where[a + k] = k
    for k in range(fronts.row[s], fronts.row[s + 1]):
        where[fronts.rows[k]] = c + k - fronts.row[s]


@compiled
def factorise(fronts: Fronts, position: Ints, values: Floats, factor: Floats) -> bool:
    """L^T of A = L L^T; False at the first pivot that is not positive.

    Args:
        fronts: of A's pattern.
        position: (K,) where each number of A's triangle belongs in the factor's numbers.
        values: (K,) the triangle.
        factor: (fronts.start[-1],) in place.
    """
    factor[:] = 0.0
    for k in range(len(position)):
        factor[position[k]] = values[k]
    count, where = len(fronts.first) - 1, np.empty(len(fronts.order), np.int64)
    below = np.diff(fronts.row)
    size, held, top, most = below * (below + 1) // 2, np.zeros(count, np.int64), 0, 0
    for s in range(count):
        top += size[s] - held[s]
        most = max(most, top)
        if below[s]:
            held[fronts.owner[fronts.rows[fronts.row[s]]]] += size[s]
    widest = np.where(below > 0, below + np.diff(fronts.first), 0).max()
    room, updates = np.empty(widest * widest), np.empty(most)
    waiting, depth, top = np.empty(count, np.int64), 0, 0
    for s in range(count):
        _, c, m = shape(fronts, s)
        block = factor[fronts.start[s] : fronts.start[s + 1]].reshape(c, m)
        front = block
        if m > c:
            front = room[: m * m].reshape(m, m)
            front[:c] = block
            for i in range(c, m):
                for j in range(i, m):
                    front[i, j] = 0.0
        locate(fronts, s, where)
        bottom = top - held[s]
        while top > bottom:
            depth -= 1
            child = waiting[depth]
            to = where[fronts.rows[fronts.row[child] : fronts.row[child + 1]]]
            top -= size[child]
            at = top
            for i in range(len(to)):
                line = front[to[i]]
                for j in range(i, len(to)):
                    line[to[j]] += updates[at]
                    at += 1
        if not eliminate(front, c):
            return False
        if m > c:
            block[:] = front[:c]
            for i in range(c, m):
                for j in range(i, m):
                    updates[top] = front[i, j]
                    top += 1
            waiting[depth] = s
            depth += 1
    return True


@compiled
def eliminate(front: Floats, c: int) -> bool:
    """L^T of the first c columns of a symmetric matrix in its upper triangle, and what they leave of the others, in
    place; False at a pivot that is not positive."""
    m = len(front)
    for outer in range(0, c, BLOCK):
        end = min(outer + BLOCK, c)
        by_loops = (end - outer) * (m - outer) ** 2 < WORTH
        for panel in range(outer, end, PANEL):
            stop = min(panel + PANEL, end)
            for k in range(panel, stop):
                if not front[k, k] > 0.0:
                    return False
                share = 1.0 / np.sqrt(front[k, k])
                for i in range(k, m):
                    front[k, i] *= share
                for j in range(k + 1, m if by_loops else stop):
                    share = front[k, j]
                    for i in range(j, m):
                        front[j, i] -= share * front[k, i]
            if not by_loops:
                downdate(front, panel, stop, end)
        if not by_loops:
            downdate(front, outer, end, m)
    return True


@compiled
def downdate(front: Floats, first: int, last: int, end: int) -> None:
    """Subtract the products of the rows first to last, which are eliminated, from those below up to `end`."""
    if last < end:
        panel = np.ascontiguousarray(front[first:last, last:].T)
        for top in range(0, end - last, STRIP):
            stop = min(top + STRIP, end - last)
            front[last + top : last + stop, last + top :] -= np.dot(panel[top:stop], panel[top:].T)


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
    out[fronts.order] = x
    return out


@compiled
def selected_inverse(fronts: Fronts, factor: Floats) -> Floats:
    """Z = A^-1 of A = L L^T where L has numbers, in the same places.

    From the last supernode to the first, with S the rows below its columns J, V = L_JJ^-T and W = V L_SJ^T:
    Z_JS = -W Z_SS, Z_JJ = V V^T - Z_JS W^T. All of Z_SS is there, since what couples two rows of a column fills in.

    References:
        Takahashi, Fagan, Chen, Formation of a sparse bus impedance matrix, 1973; Erisman and Tinney, CACM 1975.
    """
    inverse, where = np.empty(len(factor)), np.empty(len(fronts.order), np.int64)
    for s in range(len(fronts.first) - 2, -1, -1):
        _, c, m = shape(fronts, s)
        block = factor[fronts.start[s] : fronts.start[s + 1]].reshape(c, m)
        own = inverse[fronts.start[s] : fronts.start[s + 1]].reshape(c, m)
        root, rows = np.linalg.inv(np.triu(block[:, :c])), fronts.rows[fronts.row[s] : fronts.row[s + 1]]
        own[:, :c] = np.dot(root, root.T)
        if m == c:
            continue
        among, k = np.empty((m - c, m - c)), 0
        while k < m - c:
            t = fronts.owner[rows[k]]
            first, wide, high = shape(fronts, t)
            locate(fronts, t, where)
            while k < m - c and rows[k] < first + wide:
                line = fronts.start[t] + (rows[k] - first) * high
                for i in range(k, m - c):
                    among[k, i] = inverse[line + where[rows[i]]]
                    among[i, k] = among[k, i]
                k += 1
        weight = np.dot(root, np.ascontiguousarray(block[:, c:]))
        beside = np.dot(weight, among)
        own[:, c:] = -beside
        own[:, :c] += np.dot(beside, weight.T)
    return inverse


@compiled
def places(fronts: Fronts, one: Ints, other: Ints) -> Ints:
    """(K,) where pairs of columns, each of which the factor has a number for, stand among its numbers."""
    out = np.empty(len(one), np.int64)
    for k in range(len(one)):
        low, high = min(one[k], other[k]), max(one[k], other[k])
        s = fronts.owner[low]
        a, c, m = shape(fronts, s)
        along = high - a
        if along >= c:
            along = c + np.searchsorted(fronts.rows[fronts.row[s] : fronts.row[s + 1]], high)
        out[k] = fronts.start[s] + (low - a) * m + along
    return out
