"""Normal equations J^T J dx = -J^T r in square blocks, for B realisations at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints
from .linear import Linear


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which blocks (i, j), i <= j, of J^T J exist and what adds up in them; the same for all realisations.

    A measurement of two nodes adds S_i^T S_i, S_j^T S_j and S_i^T S_j. Where S_i = -S_j (see Linear) it is computed
    once and the block between them subtracts it.

    Args:
        nodes: n.
        pairs: (P, 2).
        rows: products of each block, one block after the other.
        starts: as `rows`.
        negated: (P,) blocks between nodes that only subtract.
        empty: own blocks of fixed nodes without measurements.
        minus: rows that subtract in blocks that also add.
        gradient_rows: the same for the gradient, by node.
        gradient_signs: as `gradient_rows`.
        gradient_starts: as `gradient_rows`.
        gradient_nodes: as `gradient_rows`.
        places: per factor (M, 1 or 3) the blocks of its node, or of the first, the second and the two.
        still: (n, dof) True where a node cannot move, or None.
    """

    nodes: int
    pairs: Ints
    rows: Ints
    starts: Ints
    negated: Bools
    empty: Ints
    minus: Ints
    gradient_rows: Ints
    gradient_signs: Floats
    gradient_starts: Ints
    gradient_nodes: Ints
    places: tuple[Ints, ...]
    still: Bools | None


def pattern(n: int, factors: Sequence[tuple[Ints, bool]], still: Bools | None = None) -> Pattern:
    """Pattern of n nodes from the nodes (M, arity) of each factor and whether its two derivatives are opposite."""
    keys, rows, signs = [], [], []
    ends, end_rows, end_signs = [], [], []
    top = gradient_top = 0
    for nodes, opposite in factors:
        count = len(nodes)
        row, at = top + np.arange(count), gradient_top + np.arange(count)
        first, last = nodes[:, 0], nodes[:, -1]
        pair = nodes.shape[1] == 2
        apart = pair and not opposite
        added = [(last, row + apart * count, at + apart * count)]
        if pair:
            added.append((first, row, at))
            keys.append(np.minimum(first, last) * n + np.maximum(first, last))
            rows.append(row + 2 * apart * count)
            signs.append(np.full(count, 1.0 if apart else -1.0))
        for k, (node, at, parts) in enumerate(added):
            keys.append(node * n + node)
            rows.append(at)
            signs.append(np.ones(count))
            ends.append(node)
            end_rows.append(parts)
            end_signs.append(np.full(count, -1.0 if k and opposite else 1.0))
        top += count * (3 if apart else 1)
        gradient_top += count * (2 if apart else 1)
    lone = np.empty(0, np.int64)
    if still is not None:
        lone = np.setdiff1d(np.flatnonzero(still.all(axis=1)), np.concatenate(ends))
        keys.append(lone * (n + 1))
        rows.append(np.zeros_like(lone))
        signs.append(np.ones(len(lone)))
    key, end = np.concatenate(keys), np.concatenate(ends)
    order, gradient_order = np.argsort(key, kind="stable"), np.argsort(end, kind="stable")
    blocks, starts = np.unique(key[order], return_index=True)
    gradient_nodes, gradient_starts = np.unique(end[gradient_order], return_index=True)
    sign = np.concatenate(signs)[order]
    negated = np.maximum.reduceat(sign, starts) < 0
    mixed = (sign < 0) & ~np.repeat(negated, np.diff(np.append(starts, len(sign))))
    return Pattern(
        n,
        np.stack([blocks // n, blocks % n], axis=1),
        np.concatenate(rows)[order],
        starts,
        negated,
        np.searchsorted(blocks, lone * (n + 1)),
        np.flatnonzero(mixed),
        np.concatenate(end_rows)[gradient_order],
        np.concatenate(end_signs)[gradient_order][:, None],
        gradient_starts,
        gradient_nodes,
        tuple(_places(n, blocks, nodes) for nodes, _ in factors),
        still,
    )


def _places(n: int, blocks: Ints, nodes: Ints) -> Ints:
    """Where the blocks of measurements of nodes (M, arity) are among the `blocks`, sorted keys i n + j."""
    keys = [(n + 1) * column for column in nodes.T]
    if nodes.shape[1] == 2:
        keys.append(nodes.min(axis=1) * n + nodes.max(axis=1))
    return np.searchsorted(blocks, np.stack(keys, axis=1))


def normal_equations(scheme: Pattern, linear: Linear, nodes: Sequence[Ints]) -> tuple[Floats, Floats]:
    """Blocks (B, P, dof, dof) of J^T J in the pattern's order and the gradient J^T r (B, n, dof).

    Args:
        nodes: (M, arity) of each factor.
    """
    if linear.many:
        return _compiled(scheme, linear, nodes)
    parts = [
        (jacobian.swapaxes(-1, -2) @ residual[..., None])[..., 0]
        for residual, jacobians in zip(linear.residual, linear.jacobian, strict=True)
        for jacobian in jacobians
    ]
    gradient = np.zeros((len(linear.x), scheme.nodes, parts[0].shape[-1]))
    signed = np.concatenate(parts, axis=1)[:, scheme.gradient_rows] * scheme.gradient_signs
    gradient[:, scheme.gradient_nodes] = np.add.reduceat(signed, scheme.gradient_starts, axis=1)
    return assemble(scheme, squares(linear, nodes)), gradient


def _compiled(scheme: Pattern, linear: Linear, nodes: Sequence[Ints]) -> tuple[Floats, Floats]:
    """The same by the kernels, measurement by measurement."""
    from ..kernels.normal import add_products, add_squares

    d = linear.jacobian[0][0].shape[-1]
    blocks = np.zeros((len(linear.x), len(scheme.pairs), d, d))
    gradient = np.zeros((len(linear.x), scheme.nodes, d))
    for residual, jacobians, touched, place in zip(linear.residual, linear.jacobian, nodes, scheme.places, strict=True):
        sizes = (0,) * residual.shape[2], (0,) * d
        each = [np.ascontiguousarray(jacobian) for jacobian in jacobians]
        opposed = len(each) < touched.shape[1]
        for k, jacobian in enumerate(each):
            add_squares(touched, place, k + opposed, opposed, residual, jacobian, (blocks, gradient), sizes)
        if len(each) == 2:
            add_products(touched, place, each[0], each[1], blocks, sizes)
    return _stilled(scheme, blocks), gradient


def squares(linear: Linear, nodes: Sequence[Ints]) -> list[Floats]:
    """Per factor the products of its derivatives (B, M, dof, dof): S_i^T S_i, S_j^T S_j, S_i^T S_j (i the smaller)."""
    found: list[Floats] = []
    for residual, jacobians, touched in zip(linear.residual, linear.jacobian, nodes, strict=True):
        products = [jacobian.swapaxes(-1, -2) @ jacobian for jacobian in jacobians]
        if len(jacobians) == 2:
            cross = jacobians[0].swapaxes(-1, -2) @ jacobians[1]
            swapped = (touched[:, 0] > touched[:, 1])[:, None, None]
            products.append(np.where(swapped, cross.swapaxes(-1, -2), cross))
        shape = residual.shape[:2]
        found += [p if p.shape[:2] == shape else np.broadcast_to(p, (*shape, *p.shape[-2:])) for p in products]
    return found


def assemble(scheme: Pattern, parts: Sequence[Floats]) -> Floats:
    """Blocks (B, P, dof, dof) in the pattern's order from the products of `squares`; 1 on what is still."""
    every = np.concatenate(parts, axis=1)
    dof = every.shape[-1]
    gathered = every.reshape(*every.shape[:2], dof * dof)[:, scheme.rows]
    if len(scheme.minus):
        gathered[:, scheme.minus] *= -1.0
    blocks: Floats = np.add.reduceat(gathered, scheme.starts, axis=1).reshape(len(every), -1, dof, dof)
    blocks[:, scheme.negated] *= -1.0
    blocks[:, scheme.empty] = 0.0
    return _stilled(scheme, blocks)


def _stilled(scheme: Pattern, blocks: Floats) -> Floats:
    if scheme.still is not None:
        own = np.flatnonzero(scheme.pairs[:, 0] == scheme.pairs[:, 1])
        at = np.arange(blocks.shape[-1])
        blocks[:, own[:, None], at, at] += scheme.still[scheme.pairs[own, 0]]
    return blocks
