"""Marginals of stars, whose nodes only meet at a separator: the compiled twin of `coopoc.optimize.arrowhead`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import AnyArray, Bools
from .compile import compiled


@compiled
def star_marginals(
    separator: int,
    others: AnyArray,
    corner: int,
    head: AnyArray,
    arm: AnyArray,
    transposed: AnyArray,
    blocks: AnyArray,
    gradient: AnyArray,
    cov: AnyArray,
    dx: AnyArray,
    size: Any,
) -> Bools:
    """Diagonal blocks of (J^T J)^-1 into cov (B, n, d, d), and -(J^T J)^-1 gradient into dx (B, n, d).

    With a node's own block H and its arm A to the separator: T = H^-1 A, S = corner - sum A^T T. The separator's
    covariance is S^-1, the node's H^-1 + T S^-1 T^T.

    Args:
        separator: its node.
        others: (G,) nodes around it.
        corner: block of the separator among `blocks`.
        head: (G,) block of each node.
        arm: (G,) block of each node and the separator, -1 for none.
        transposed: (G,) whether an arm's block is that of (separator, node).
        blocks: (B, P, d, d) of J^T J.
        gradient: (B, n, d).
        cov: (B, n, d, d), filled.
        dx: (B, n, d), filled.
        size: a tuple of length d, which the compiler unrolls.

    Returns:
        (B,) False where a block is not positive definite; cov and dx are not filled there.
    """
    d, sound = len(size), np.empty(len(blocks), np.bool_)
    inner, solved = np.empty((len(others), d, d)), np.empty((len(others), d, d))
    schur, inverse, product, step = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty(d)
    for b in range(len(blocks)):
        sound[b] = True
        for i in range(len(size)):
            step[i] = -gradient[b, separator, i]
            for j in range(len(size)):
                schur[i, j] = blocks[b, corner, i, j]
        for g in range(len(others)):
            sound[b] &= invert(blocks[b, head[g]], inner[g], size)
            if arm[g] < 0:
                continue
            A = blocks[b, arm[g]].T if transposed[g] else blocks[b, arm[g]]
            eta = gradient[b, others[g]]
            for i in range(len(size)):
                for j in range(len(size)):
                    total = 0.0
                    for k in range(len(size)):
                        total += inner[g, i, k] * A[k, j]
                    solved[g, i, j] = total
            for i in range(len(size)):
                for k in range(len(size)):
                    step[i] += solved[g, k, i] * eta[k]
                    for j in range(len(size)):
                        schur[i, j] -= A[k, i] * solved[g, k, j]
        sound[b] &= invert(schur, inverse, size)
        if sound[b]:
            cov[b, separator], dx[b, separator] = inverse, 0.0
            for i in range(len(size)):
                for k in range(len(size)):
                    dx[b, separator, i] += inverse[i, k] * step[k]
            for g in range(len(others)):
                back_substitute(
                    gradient[b, others[g]],
                    inner[g],
                    solved[g],
                    inverse,
                    step,
                    product,
                    cov[b, others[g]],
                    dx[b, others[g]],
                    arm[g] >= 0,
                    size,
                )
    return sound


@compiled
def back_substitute(
    eta: AnyArray,
    inner: AnyArray,
    solved: AnyArray,
    separator: AnyArray,
    step: AnyArray,
    product: AnyArray,
    cov: AnyArray,
    dx: AnyArray,
    linked: bool,
    size: Any,
) -> None:
    """Covariance and step of one node from those of the separator."""
    for i in range(len(size)):
        total = 0.0
        for k in range(len(size)):
            total += inner[i, k] * eta[k]
            cov[i, k] = inner[i, k]
        if linked:
            for j in range(len(size)):
                product[i, j] = 0.0
                for k in range(len(size)):
                    product[i, j] += solved[i, k] * separator[k, j]
            for k in range(len(size)):
                total += product[i, k] * step[k]
            for j in range(len(size)):
                for k in range(len(size)):
                    cov[i, j] += product[i, k] * solved[j, k]
        dx[i] = -total


@compiled
def invert(matrix: AnyArray, out: AnyArray, size: Any) -> bool:
    """The inverse of a symmetric matrix (d, d); False if it is not positive definite.

    By L L^T = matrix: L and then L^-1 stand below the diagonal of `out`, whose upper half gets L^-T L^-1.
    """
    for j in range(len(size)):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= out[j, k] * out[j, k]
        if not pivot > 0.0:
            return False
        out[j, j] = 1.0 / math.sqrt(pivot)
        for i in range(j + 1, len(size)):
            total = matrix[i, j]
            for k in range(j):
                total -= out[i, k] * out[j, k]
            out[i, j] = total * out[j, j]
    for j in range(len(size)):
        for i in range(j + 1, len(size)):
            total = 0.0
            for k in range(j, i):
                total -= out[i, k] * out[k, j]
            out[i, j] = total * out[i, i]
    for i in range(len(size)):
        for j in range(i, len(size)):
            total = 0.0
            for k in range(j, len(size)):
                total += out[k, i] * out[k, j]
            out[i, j] = total
    for i in range(len(size)):
        for j in range(i):
            out[i, j] = out[j, i]
    return True
