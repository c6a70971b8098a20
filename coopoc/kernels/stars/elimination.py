"""Symmetric positive definite matrices of 3 x 3 blocks in information form: eliminate, substitute, predict.

A matrix of n x n blocks stands in memory as `compiling.small` keeps it: block (i, j), j >= i, is tuple number
i stride + j; those below the diagonal are never read.
A number is a float, or LANES runs side by side.
"""

from __future__ import annotations

from ...arrays import Floats
from ..compiling.compile import inner
from ..compiling.small import (
    add_diagonal,
    inverse,
    less_applied,
    less_transposed_applied,
    less_transposed_product,
    load,
    minus_apply,
    minus_product,
    mirrored,
    negate,
    store,
    transpose,
)
from .messages import BLOCK, ROW
from .relative import Numbers


@inner
def eliminate(source: Floats, a: Floats, eta: Floats, n: int, stride: int, memory: Floats) -> Numbers:
    """Factorise A = R^T D R: D^-1 R in `a` (which may be `source`), minus the inverse pivots on its diagonal, and
    D^-1 R^-T eta in place of eta.

    Returns the last of them, -Cov of the last block. The next pivot is inverted as soon as its row is ready, while the
    rows below are still worked on. `memory` holds n blocks.
    """
    p: Numbers = negate(inverse(load(source, 0, BLOCK)))
    for k in range(n):
        first = k * stride
        v = minus_apply(p, load(eta, k, ROW))
        store(eta, k, v)
        store(a, first + k, p)
        for j in range(k + 1, n):
            one = load(source, first + j, BLOCK)
            store(memory, j, one)
            store(a, first + j, minus_product(p, one))
        for i in range(k + 1, n):
            left = load(memory, i, BLOCK)
            for j in range(i, n):
                at = i * stride + j
                store(a, at, less_transposed_product(load(source, at, BLOCK), left, load(a, first + j, BLOCK)))
            store(eta, i, less_transposed_applied(load(eta, i, ROW), left, v))
            if i == k + 1:
                p = negate(inverse(load(a, i * stride + i, BLOCK)))
        source = a
    return p


@inner
def substitute(factor: Floats, x: Floats, n: int, stride: int) -> None:
    """Solution A^-1 eta in place of what `eliminate` left in eta."""
    for k in range(n - 1, -1, -1):
        v = load(x, k, ROW)
        for j in range(k + 1, n):
            v = less_applied(v, load(factor, k * stride + j, BLOCK), load(x, j, ROW))
        store(x, k, v)


@inner
def predict(a: Floats, n: int, stride: int, process: Floats, memory: Floats) -> None:
    """Information (A^-1 + Q)^-1 in place of A, Q^-1 = diag(process): with infinite process noise (0) a block is
    forgotten, one after the other as a rank-3 update. `memory` holds 2 n blocks.

    With E_k the columns of block k and W_k = Q_k^-1, A <- A - A E_k (E_k^T A E_k + W_k)^-1 E_k^T A.
    """
    for k in range(n):
        for i in range(k):
            store(memory, n + i, transpose(load(a, i * stride + k, BLOCK)))
        for j in range(k + 1, n):
            store(memory, n + j, load(a, k * stride + j, BLOCK))
        own = mirrored(load(a, k * stride + k, BLOCK))
        store(memory, n + k, own)
        pivot = negate(inverse(add_diagonal(own, load(process, k, ROW))))
        for j in range(n):
            store(memory, j, minus_product(pivot, load(memory, n + j, BLOCK)))
        for i in range(n):
            left = load(memory, n + i, BLOCK)
            for j in range(i, n):
                at = i * stride + j
                store(a, at, less_transposed_product(load(a, at, BLOCK), left, load(memory, j, BLOCK)))
