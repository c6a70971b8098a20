"""The algebra of `coopoc.kernels.blocks` for several runs abreast: same steps, same order, same digits.

A matrix of n x n blocks is a flat array of vectors: block (i, j), j >= i, is number (i stride + j) of nine, row by row;
of those below the diagonal nothing is kept. The right-hand side stands beside it, three to a block.
"""

from __future__ import annotations

from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .abreast import less, put, take
from .blocks import inverse3
from .compile import as_written


@as_written
def nine(a: AnyArray, at: int) -> Any:
    """Block number `at`."""
    k, o = uint64(9) * uint64(at), uint64(1)
    return (take(a, k), take(a, k + o), take(a, k + uint64(2)), take(a, k + uint64(3)), take(a, k + uint64(4)),
            take(a, k + uint64(5)), take(a, k + uint64(6)), take(a, k + uint64(7)), take(a, k + uint64(8)))  # fmt: skip


@as_written
def put_nine(a: AnyArray, at: int, block: Any) -> None:
    """Write block number `at`."""
    k = uint64(9) * uint64(at)
    put(a, k + uint64(0), block[0])
    put(a, k + uint64(1), block[1])
    put(a, k + uint64(2), block[2])
    put(a, k + uint64(3), block[3])
    put(a, k + uint64(4), block[4])
    put(a, k + uint64(5), block[5])
    put(a, k + uint64(6), block[6])
    put(a, k + uint64(7), block[7])
    put(a, k + uint64(8), block[8])


@as_written
def three(x: AnyArray, at: int) -> Any:
    """Three of a right-hand side."""
    k = uint64(3) * uint64(at)
    return take(x, k), take(x, k + uint64(1)), take(x, k + uint64(2))


@as_written
def put_three(x: AnyArray, at: int, values: Any) -> None:
    """Write three of a right-hand side."""
    k = uint64(3) * uint64(at)
    put(x, k, values[0])
    put(x, k + uint64(1), values[1])
    put(x, k + uint64(2), values[2])


@as_written
def row_less(t: Any, a: Any, b: Any, c: Any, rows: Any) -> Any:
    """Three numbers less a, b, c times three rows of three."""
    p, q, r, s, u, v, w, x, y = rows
    return (less(less(less(t[0], a, p), b, s), c, w), less(less(less(t[1], a, q), b, u), c, x),
            less(less(less(t[2], a, r), b, v), c, y))  # fmt: skip


@as_written
def subtract(source: AnyArray, out: AnyArray, at: int, left: Any, right: Any) -> None:
    """Block `at` is that of `source` less the transposed left one times the right one."""
    t = nine(source, at)
    a, b, c, d, e, f, g, h, i = left
    one = row_less((t[0], t[1], t[2]), a, d, g, right)
    two = row_less((t[3], t[4], t[5]), b, e, h, right)
    six = row_less((t[6], t[7], t[8]), c, f, i, right)
    put_nine(out, at, (one[0], one[1], one[2], two[0], two[1], two[2], six[0], six[1], six[2]))


@as_written
def row_of(a: Any, b: Any, c: Any, rows: Any) -> Any:
    """Minus a, b, c times three rows of three."""
    p, q, r, s, u, v, w, x, y = rows
    return (less(less(-(a * p), b, s), c, w), less(less(-(a * q), b, u), c, x), less(less(-(a * r), b, v), c, y))


@as_written
def minus_product(p: Any, rows: Any) -> Any:
    """Minus a symmetric block, given by its upper triangle, times three rows."""
    a, b, c, d, e, f = p
    x, y, z = row_of(a, b, c, rows), row_of(b, d, e, rows), row_of(c, e, f, rows)
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@as_written
def minus_inverse(block: Any) -> Any:
    """Upper triangle of minus the inverse of a block, from its upper triangle."""
    a, b, c, d, e, f = inverse3(block[0], block[1], block[2], block[4], block[5], block[8])
    return -a, -b, -c, -d, -e, -f


@as_written
def eliminate(source: AnyArray, a: AnyArray, b: AnyArray, n: int, stride: int, memory: AnyArray) -> Any:
    """R of `source` in `a`, which may be the same, D^-1 R^-T b in place of b; upper triangle of the last -D^-1.

    The next pivot is inverted as soon as its row is ready, while the rows below are still worked on. `memory` holds
    nine vectors a block.
    """
    p = minus_inverse(nine(source, 0))
    for k in range(n):
        row, (u, v, w) = k * stride, three(b, k)
        u, v, w = (less(less(-(p[0] * u), p[1], v), p[2], w), less(less(-(p[1] * u), p[3], v), p[4], w),
                   less(less(-(p[2] * u), p[4], v), p[5], w))  # fmt: skip
        put_three(b, k, (u, v, w))
        for j in range(k + 1, n):
            block = nine(source, row + j)
            put_nine(memory, j, block)
            put_nine(a, row + j, minus_product(p, block))
        for i in range(k + 1, n):
            left, (x, y, z) = nine(memory, i), three(b, i)
            for j in range(i, n):
                subtract(source, a, i * stride + j, left, nine(a, row + j))
            x = less(less(less(x, left[0], u), left[3], v), left[6], w)
            y = less(less(less(y, left[1], u), left[4], v), left[7], w)
            z = less(less(less(z, left[2], u), left[5], v), left[8], w)
            put_three(b, i, (x, y, z))
            if i == k + 1:
                p = minus_inverse(nine(a, i * stride + i))
        source = a
    return p


@as_written
def substitute(factor: AnyArray, x: AnyArray, n: int, stride: int) -> None:
    """Solution in place of the right-hand side of what was eliminated."""
    for k in range(n - 1, -1, -1):
        a, b, c = three(x, k)
        for j in range(k + 1, n):
            f, (u, v, w) = nine(factor, k * stride + j), three(x, j)
            a = less(less(less(a, f[0], u), f[1], v), f[2], w)
            b = less(less(less(b, f[3], u), f[4], v), f[5], w)
            c = less(less(less(c, f[6], u), f[7], v), f[8], w)
        put_three(x, k, (a, b, c))


@as_written
def loosen(a: AnyArray, n: int, stride: int, stiffness: AnyArray, memory: AnyArray) -> None:
    """Information (A^-1 + Q)^-1 in place of A, as `coopoc.kernels.blocks` says; `memory` of 18 vectors a block."""
    for k in range(n):
        for i in range(k):
            p, q, r, s, t, u, v, w, x = nine(a, i * stride + k)
            put_nine(memory, i, (p, s, v, q, t, w, r, u, x))
        for j in range(k, n):
            put_nine(memory, j, nine(a, k * stride + j))
        p, q, r, _, t, u, _, _, x = nine(memory, k)
        put_nine(memory, k, (p, q, r, q, t, u, r, u, x))
        e, f, g = three(stiffness, k)
        pivot = minus_inverse((p + e, q, r, q, t + f, u, r, u, x + g))
        for j in range(n):
            put_nine(memory, n + j, minus_product(pivot, nine(memory, j)))
        for i in range(n):
            left = nine(memory, i)
            for j in range(i, n):
                subtract(a, a, i * stride + j, left, nine(memory, n + j))
