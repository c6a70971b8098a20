"""Normal equations J^T J dx = -J^T r in square blocks, summed measurement by measurement."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arrays import AnyArray
from ..compiling.compile import compiled, part


@compiled
def add_squares(
    nodes: AnyArray,
    place: AnyArray,
    which: int,
    opposed: bool,
    residual: AnyArray,
    jacobian: AnyArray,
    out: Any,
    sizes: Any,
) -> None:
    """Add S^T S to blocks and S^T r to the gradient, S the derivative by one of the nodes.

    Args:
        nodes: (M, arity).
        place: (M, 1) the block of the node, or (M, 3) those of the first, the second and the two.
        which: of the nodes.
        opposed: the other node's derivative is -S, and adds too.
        residual: (B, M, k) r.
        jacobian: (B or 1, M or 1, k, d) S.
        out: blocks (B, P, d, d) and gradient (B, n, d).
        sizes: tuples of length k and d, so that the compiler knows both.
    """
    (blocks, gradient), square = out, np.empty((len(sizes[1]), len(sizes[1])))
    for b in range(len(residual)):
        each = jacobian[b % len(jacobian)]
        for m in range(len(nodes)):
            S, r, node_gradient = each[m % len(each)], residual[b, m], gradient[b, nodes[m, which]]
            for i in range(len(sizes[1])):
                total = 0.0
                for k in range(len(sizes[0])):
                    total += S[k, i] * r[k]
                node_gradient[i] += total
                if opposed:
                    gradient[b, nodes[m, 1 - which], i] -= total
                for j in range(len(sizes[1])):
                    total = 0.0
                    for k in range(len(sizes[0])):
                        total += S[k, i] * S[k, j]
                    square[i, j] = total
            add(blocks[b, place[m, which]], 1.0, square, sizes[1])
            if opposed:
                add(blocks[b, place[m, 1 - which]], 1.0, square, sizes[1])
                add(blocks[b, place[m, 2]], -1.0, square, sizes[1])


@part
def add(out: AnyArray, sign: float, square: AnyArray, size: Any) -> None:
    """Add sign times a matrix (d, d)."""
    for i in range(len(size)):
        for j in range(len(size)):
            out[i, j] += sign * square[i, j]


@compiled
def add_products(
    nodes: AnyArray, place: AnyArray, first: AnyArray, second: AnyArray, blocks: AnyArray, sizes: Any
) -> None:
    """Add S_i^T S_j, i the smaller of a pair's nodes (M, 2), to the blocks `place[:, 2]` of (B, P, d, d).

    Args:
        first: (B or 1, M or 1, k, d) derivative by the first node.
        second: (B or 1, M or 1, k, d) derivative by the second node.
        sizes: as `add_squares`.
    """
    for b in range(len(blocks)):
        one, two = first[b % len(first)], second[b % len(second)]
        for m in range(len(nodes)):
            S, T, block = one[m % len(one)], two[m % len(two)], blocks[b, place[m, 2]]
            if nodes[m, 0] > nodes[m, 1]:
                S, T = T, S
            for i in range(len(sizes[1])):
                for j in range(len(sizes[1])):
                    total = 0.0
                    for k in range(len(sizes[0])):
                        total += S[k, i] * T[k, j]
                    block[i, j] += total
