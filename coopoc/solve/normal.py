"""Normal equations J^T J dx = -J^T r in 3x3 blocks, for B realisations at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from .problem import Linear


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which 3x3 blocks of J^T J exist and what adds up in them; the same for all realisations.

    Args:
        points: n. pairs: (P, 2) blocks (i, j), i <= j. order, starts: gather contributions of each block.
        grad_order, grad_starts, grad_points: the same for the gradient.
        arity: per factor.
    """

    points: int
    pairs: Ints
    order: Ints
    starts: Ints
    grad_order: Ints
    grad_starts: Ints
    grad_points: Ints
    arity: tuple[int, ...]


def pattern(n: int, nodes: Sequence[Ints]) -> Pattern:
    """Pattern of n points whose factors touch `nodes`, (M, arity) per factor."""
    keys, points = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for touched in nodes:
        for p in touched.T:
            keys.append(p * n + p)
            points.append(p)
        if touched.shape[1] == 2:
            keys.append(touched.min(axis=1) * n + touched.max(axis=1))
    key, point = np.concatenate(keys), np.concatenate(points)
    order, grad_order = np.argsort(key, kind="stable"), np.argsort(point, kind="stable")
    unique, starts = np.unique(key[order], return_index=True)
    grad_points, grad_starts = np.unique(point[grad_order], return_index=True)
    return Pattern(n, np.stack([unique // n, unique % n], axis=1), order, starts, grad_order, grad_starts, grad_points,
                   tuple(touched.shape[1] for touched in nodes))  # fmt: skip


def normal_equations(scheme: Pattern, linear: Linear) -> tuple[Floats, Floats]:
    """Blocks (B, P, 3, 3) of J^T J in the pattern's order and the gradient J^T r (B, n, 3)."""
    batch = len(linear.x)
    blocks, pulls = [], []
    for arity, residual, slope in zip(scheme.arity, linear.residual, linear.slope, strict=True):
        turned = np.swapaxes(slope, -1, -2)
        count = residual.shape[1]
        square = np.broadcast_to(turned @ slope, (batch, count, 3, 3)).reshape(batch, count, 9)
        pull = np.broadcast_to((turned @ residual[..., None])[..., 0], (batch, count, 3))
        blocks += [square] if arity == 1 else [square, square, -square]
        pulls += [pull] if arity == 1 else [-pull, pull]
    gathered = np.concatenate(blocks, axis=1)[:, scheme.order]
    summed = np.add.reduceat(gathered, scheme.starts, axis=1).reshape(batch, -1, 3, 3)
    gradient = np.zeros((batch, scheme.points, 3))
    gradient[:, scheme.grad_points] = np.add.reduceat(
        np.concatenate(pulls, axis=1)[:, scheme.grad_order], scheme.grad_starts, axis=1
    )
    return summed, gradient
