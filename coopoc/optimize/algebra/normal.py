"""Normal equations J^T J dx = -J^T r in square blocks, for B realisations at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..model.linear import Linear


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which blocks (i, j), i <= j, of J^T J exist and where each measurement adds to them; the same for all
    realisations.

    Args:
        nodes: n.
        pairs: (P, 2).
        places: per factor (M, 1 or 3) the blocks of its node, or of the first, the second and the two.
        still: (n, dof) True where a node cannot move, or None.
    """

    nodes: int
    pairs: Ints
    places: tuple[Ints, ...]
    still: Bools | None


def pattern(n: int, factors: Sequence[Ints], still: Bools | None = None) -> Pattern:
    """Pattern of n nodes from the nodes (M, arity) of each factor; a node that cannot move has a block, too."""
    lone = np.empty(0, np.int64) if still is None else np.flatnonzero(still.all(axis=1)) * (n + 1)
    keys = [_keys(n, nodes) for nodes in factors]
    blocks = np.unique(np.concatenate([lone, *(key.ravel() for key in keys)]))
    places = tuple(np.searchsorted(blocks, key) for key in keys)
    return Pattern(n, np.stack([blocks // n, blocks % n], axis=1), places, still)


def _keys(n: int, nodes: Ints) -> Ints:
    """(M, 1 or 3) i n + j of the blocks (i, j) that measurements of nodes (M, arity) add to."""
    keys = [(n + 1) * column for column in nodes.T]
    if nodes.shape[1] == 2:
        keys.append(nodes.min(axis=1) * n + nodes.max(axis=1))
    return np.stack(keys, axis=1)


def normal_equations(scheme: Pattern, linear: Linear, nodes: Sequence[Ints]) -> tuple[Floats, Floats]:
    """Blocks (B, P, dof, dof) of J^T J in the pattern's order and the gradient J^T r (B, n, dof).

    Args:
        nodes: (M, arity) of each factor.
    """
    from ...kernels.graphs.normal import add_products, add_squares

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
    return stilled(scheme, blocks), gradient


def assemble(scheme: Pattern, parts: Sequence[Sequence[Floats]]) -> Floats:
    """Blocks (P, dof, dof) in the pattern's order from the blocks (M, dof, dof) of each factor's measurements.

    Args:
        parts: of each factor the blocks of its node, or of the first, the second and the two (i the smaller), or of
            the first where the second has the same and the two have minus that.
    """
    blocks = np.zeros((len(scheme.pairs), *parts[0][0].shape[1:]))
    for own, place in zip(parts, scheme.places, strict=True):
        every = (own[0], own[0], -own[0]) if len(own) < place.shape[1] else own
        for each, at in zip(every, place.T, strict=True):
            np.add.at(blocks, at, each)
    stilled(scheme, blocks[None])
    return blocks


def stilled(scheme: Pattern, blocks: Floats) -> Floats:
    """Blocks (B, P, dof, dof) with 1 added for what cannot move, in place."""
    if scheme.still is not None:
        own = np.flatnonzero(scheme.pairs[:, 0] == scheme.pairs[:, 1])
        at = np.arange(blocks.shape[-1])
        blocks[:, own[:, None], at, at] += scheme.still[scheme.pairs[own, 0]]
    return blocks
