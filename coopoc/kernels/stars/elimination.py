"""Symmetric positive definite matrices of d x d blocks in information form: eliminate, substitute, predict.

A matrix of n x n blocks stands in memory as `compiling.small` keeps it: block (i, j), j >= i, is tuple number
i stride + j; those below the diagonal are never read. The arguments `block` and `row` are any tuples of d * d and of d
numbers: the compiler takes d from their lengths. A number is a float, or LANES runs side by side.
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
from .relative import Numbers


@inner
def eliminate(
    source: Floats, a: Floats, eta: Floats, n: int, stride: int, memory: Floats, block: Numbers, row: Numbers
) -> Numbers:
    """Factorise A = R^T D R: D^-1 R in `a` (which may be `source`), minus the inverse pivots on its diagonal, and
    D^-1 R^-T eta in place of eta.

    Returns the last of them, -Cov of the last block. The next pivot is inverted as soon as its row is ready, while the
    rows below are still worked on. `memory` holds n blocks.
    """
    p: Numbers = negate(inverse(load(source, 0, block)))
    for k in range(n):
        first = k * stride
        v = minus_apply(p, load(eta, k, row))
        store(eta, k, v)
        store(a, first + k, p)
        for j in range(k + 1, n):
            one = load(source, first + j, block)
            store(memory, j, one)
            store(a, first + j, minus_product(p, one))
        for i in range(k + 1, n):
            left = load(memory, i, block)
            for j in range(i, n):
                at = i * stride + j
                store(a, at, less_transposed_product(load(source, at, block), left, load(a, first + j, block)))
            store(eta, i, less_transposed_applied(load(eta, i, row), left, v))
            if i == k + 1:
                p = negate(inverse(load(a, i * stride + i, block)))
        source = a
    return p


@inner
def substitute(factor: Floats, x: Floats, n: int, stride: int, block: Numbers, row: Numbers) -> None:
    """Solution A^-1 eta in place of what `eliminate` left in eta."""
    for k in range(n - 1, -1, -1):
        v = load(x, k, row)
        for j in range(k + 1, n):
            v = less_applied(v, load(factor, k * stride + j, block), load(x, j, row))
        store(x, k, v)


@inner
def predict(a: Floats, n: int, stride: int, process: Floats, memory: Floats, block: Numbers, row: Numbers) -> None:
    """Information (A^-1 + Q)^-1 in place of A, Q^-1 = diag(process): with infinite process noise (0) a block is
    forgotten, one after the other as a rank-d update. `memory` holds 2 n blocks.

    With E_k the columns of block k and W_k = Q_k^-1, A <- A - A E_k (E_k^T A E_k + W_k)^-1 E_k^T A.
    """
    for k in range(n):
        for i in range(k):
            store(memory, n + i, transpose(load(a, i * stride + k, block)))
        for j in range(k + 1, n):
            store(memory, n + j, load(a, k * stride + j, block))
        own = mirrored(load(a, k * stride + k, block))
        store(memory, n + k, own)
        pivot = negate(inverse(add_diagonal(own, load(process, k, row))))
        for j in range(n):
            store(memory, j, minus_product(pivot, load(memory, n + j, block)))
        for i in range(n):
            left = load(memory, n + i, block)
            for j in range(i, n):
                at = i * stride + j
                store(a, at, less_transposed_product(load(a, at, block), left, load(memory, j, block)))
