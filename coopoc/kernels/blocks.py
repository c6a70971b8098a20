"""Symmetric positive definite matrices of 3x3 blocks: eliminate, substitute back, let parts move.

A matrix (n, n) is a flat array, rows `stride` > n apart, of which the upper triangle counts; the column n holds a
right-hand side, those behind it zeros. A = R^T D R with R unit upper triangular by blocks: elimination leaves R off the
diagonal and D^-1 R^-T b beside it. The last block of D^-1 is that of the inverse. n^3 / 3 flops, and n^3 to let all
parts move. Inner loops count in unsigned numbers, which index without a look at their sign.
"""

from __future__ import annotations

from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .abreast import less, plus
from .compile import as_written
from .lanes import LANES, minus_product, subtract


@as_written
def inverse3(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> Any:
    """Upper triangle of the inverse of a symmetric (3, 3), row by row, from the upper triangle."""
    a, b, c = less(yy * zz, yz, yz), less(xz * yz, xy, zz), less(xy * yz, xz, yy)
    scale = 1.0 / plus(plus(xx * a, xy, b), xz, c)
    return (a * scale, b * scale, c * scale, less(xx * zz, xz, xz) * scale, less(xy * xz, xx, yz) * scale,
            less(xx * yy, xy, xy) * scale)  # fmt: skip


@as_written
def width(n: int) -> int:
    """Stride of a matrix (n, n) with its right-hand side."""
    return (n + LANES) // LANES * LANES


@as_written
def eliminate(a: AnyArray, n: int, stride: int, factor: AnyArray, pivots: AnyArray) -> None:
    """Upper triangle of `a`, which is used up, to R and the right-hand side in `factor`, -D^-1 in `pivots` (3n,).

    The next pivot is inverted as soon as its row is ready, while the rows below are still worked on.
    """
    _pivot(a, 0, stride, pivots)
    for k in range(0, n, 3):
        j = (k + 3) // LANES * LANES
        minus_product(factor, k * stride + j, pivots, 3 * k, a, k * stride + j, stride, (stride - j) // LANES)
        for i in range(k + 3, n, 3):
            j = i // LANES * LANES
            subtract(a, i * stride + j, a, k * stride + i, factor, k * stride + j, stride, (stride - j) // LANES)
            if i == k + 3:
                _pivot(a, i, stride, pivots)


@as_written
def _pivot(a: AnyArray, k: int, stride: int, pivots: AnyArray) -> None:
    at, step, one, two = uint64(k * (stride + 1)), uint64(stride), uint64(1), uint64(2)
    xx, xy, xz, yy, yz = a[at], a[at + one], a[at + two], a[at + step + one], a[at + step + two]
    _minus_inverse(xx, xy, xz, yy, yz, a[at + step + step + two], pivots, 3 * k)


@as_written
def _minus_inverse(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, pivots: AnyArray, place: int
) -> None:  # fmt: skip
    """Minus the inverse of a block, whole, at a place of `pivots`."""
    xx, xy, xz, yy, yz, zz = inverse3(xx, xy, xz, yy, yz, zz)
    at, one = uint64(place), uint64(1)
    for value in (xx, xy, xz, xy, yy, yz, xz, yz, zz):
        pivots[at] = -value
        at += one


@as_written
def substitute(factor: AnyArray, n: int, stride: int, x: AnyArray) -> None:
    """Solution x (n,) of what was eliminated."""
    for k in range(n - 3, -1, -3):
        row, end, step = uint64(k * stride), uint64(n), uint64(stride)
        a, b, c = factor[row + end], factor[row + step + end], factor[row + step + step + end]
        for j in range(uint64(k + 3), end):
            known = x[j]
            a = less(a, factor[row + j], known)
            b = less(b, factor[row + step + j], known)
            c = less(c, factor[row + step + step + j], known)
        x[k], x[k + 1], x[k + 2] = a, b, c


@as_written
def loosen(a: AnyArray, n: int, stride: int, stiffness: AnyArray, memory: AnyArray) -> None:
    """Information (A^-1 + Q)^-1 in place of A, Q the inverse of the diagonal `stiffness` (n,); zero marginalises.

    A - U (A_kk + Q_k^-1)^-1 U^T with U the columns of the block k, block by block: no difference of near numbers,
    however large or small Q is. `memory` (>= 6 stride + 9,) is scratch.
    """
    u, v, pivot = memory[: 3 * stride], memory[3 * stride : 6 * stride], memory[6 * stride :]
    step, one, two = uint64(stride), uint64(1), uint64(2)
    for k in range(0, n, 3):
        column = uint64(k)
        for i in range(column):
            at = i * step + column
            u[i], u[i + step], u[i + step + step] = a[at], a[at + one], a[at + two]
        at = column * step
        for j in range(column, step):
            u[j], u[j + step], u[j + step + step] = a[at + j], a[at + step + j], a[at + step + step + j]
        u[column + step], u[column + step + step] = u[column + one], u[column + two]
        u[column + step + step + one] = u[column + step + two]
        _minus_inverse(
            u[column] + stiffness[k], u[column + one], u[column + two], u[column + step + one] + stiffness[k + 1],
            u[column + step + two], u[column + step + step + two] + stiffness[k + 2], pivot, 0,
        )  # fmt: skip
        minus_product(v, 0, pivot, 0, u, 0, stride, stride // LANES)
        for i in range(0, n, 3):
            j = i // LANES * LANES
            subtract(a, i * stride + j, u, i, v, j, stride, (stride - j) // LANES)
