"""Marginals of stars, whose nodes only meet at a separator of one node."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, Bools, Floats, Ints
from ..compiling.compile import compiled, part


class Star(NamedTuple):
    """Nodes around a separator, and where the blocks of J^T J stand.

    Args:
        separator: its node.
        others: (G,) nodes around it.
        corner: block of the separator.
        head: (G,) block of each node.
        arm: (G,) block of each node and the separator, -1 for none.
        transposed: (G,) whether an arm's block is that of (separator, node).
    """

    separator: int
    others: Ints
    corner: int
    head: Ints
    arm: Ints
    transposed: Bools


class Solved(NamedTuple):
    """Covariance (B, n, d, d) of each node and the Newton step dx (B, n, d)."""

    cov: Floats
    dx: Floats


@compiled
def star_marginals(star: Star, blocks: AnyArray, gradient: AnyArray, found: Solved, size: Any) -> Bools:
    """Diagonal blocks of (J^T J)^-1 and -(J^T J)^-1 gradient.

    With a node's own block H and its arm A to the separator: T = H^-1 A, S = corner - sum A^T T. The separator's
    covariance is S^-1, the node's H^-1 + T S^-1 T^T.

    Args:
        star: the graph.
        blocks: (B, P, d, d) of J^T J.
        gradient: (B, n, d).
        found: filled.
        size: a tuple of length d, which the compiler unrolls.

    Returns:
        (B,) False where a block is not positive definite; `found` is not filled there.
    """
    d, many, sound = len(size), len(star.others), np.empty(len(blocks), np.bool_)
    inner, solved = np.empty((many, d, d)), np.empty((many, d, d))
    schur, inverse, product, step = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty(d)
    for b in range(len(blocks)):
        sound[b] = True
        for i in range(len(size)):
            step[i] = -gradient[b, star.separator, i]
            for j in range(len(size)):
                schur[i, j] = blocks[b, star.corner, i, j]
        for g in range(many):
            sound[b] &= invert(blocks[b, star.head[g]], inner[g], size)
            if star.arm[g] >= 0:
                arm = blocks[b, star.arm[g]].T if star.transposed[g] else blocks[b, star.arm[g]]
                eliminate(inner[g], arm, gradient[b, star.others[g]], solved[g], schur, step, size)
        sound[b] &= invert(schur, inverse, size)
        if sound[b]:
            solve(inverse, step, 1.0, (found.cov[b, star.separator], found.dx[b, star.separator]), size)
            for g in range(many):
                out = found.cov[b, star.others[g]], found.dx[b, star.others[g]]
                solve(inner[g], gradient[b, star.others[g]], -1.0, out, size)
                if star.arm[g] >= 0:
                    back_substitute(solved[g], inverse, step, product, out, size)
    return sound


@part
def eliminate(
    inner: AnyArray, arm: AnyArray, eta: AnyArray, solved: AnyArray, schur: AnyArray, step: AnyArray, size: Any
) -> None:
    """T = H^-1 A of a node, and what it takes from the separator's block and adds to its step."""
    for i in range(len(size)):
        for j in range(len(size)):
            total = 0.0
            for k in range(len(size)):
                total += inner[i, k] * arm[k, j]
            solved[i, j] = total
    for i in range(len(size)):
        for k in range(len(size)):
            step[i] += solved[k, i] * eta[k]
            for j in range(len(size)):
                schur[i, j] -= arm[k, i] * solved[k, j]


@part
def solve(inverse: AnyArray, eta: AnyArray, sign: float, out: Any, size: Any) -> None:
    """Covariance H^-1 and step +-H^-1 eta of one node."""
    cov, dx = out
    for i in range(len(size)):
        total = 0.0
        for k in range(len(size)):
            total += inverse[i, k] * eta[k]
            cov[i, k] = inverse[i, k]
        dx[i] = sign * total


@part
def back_substitute(
    solved: AnyArray, inverse: AnyArray, step: AnyArray, product: AnyArray, out: Any, size: Any
) -> None:
    """Add to covariance and step of one node what comes from those of the separator."""
    cov, dx = out
    for i in range(len(size)):
        for j in range(len(size)):
            product[i, j] = 0.0
            for k in range(len(size)):
                product[i, j] += solved[i, k] * inverse[k, j]
        for k in range(len(size)):
            dx[i] -= product[i, k] * step[k]
        for j in range(len(size)):
            for k in range(len(size)):
                cov[i, j] += product[i, k] * solved[j, k]


@part
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
