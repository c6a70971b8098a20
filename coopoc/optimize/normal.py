"""Normal equations J^T J dx = -J^T r in 3x3 blocks, for B realisations at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from .problem import Linear


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which 3x3 blocks of J^T J exist and which measurements add up in them; the same for all realisations.

    A measurement with derivative S by its vector adds S^T S to the diagonal blocks of its points and, if it has two,
    -S^T S to the block between them: every block is symmetric.

    Args:
        points: n. pairs: (P, 2) blocks (i, j), i <= j. rows, starts: measurements of each block, one after the other.
        pull_rows, pull_signs, pull_starts, pull_points: the same for the gradient, by point.
    """

    points: int
    pairs: Ints
    rows: Ints
    starts: Ints
    pull_rows: Ints
    pull_signs: Floats
    pull_starts: Ints
    pull_points: Ints


def pattern(n: int, nodes: Sequence[Ints]) -> Pattern:
    """Pattern of n points whose factors touch `nodes`, (M, arity) per factor."""
    keys, rows, points, signs, point_rows, top = [], [], [], [], [], 0
    for touched in nodes:
        row = top + np.arange(len(touched))
        top += len(touched)
        ends = ((-1.0, touched[:, 0]), (1.0, touched[:, -1]))[2 - touched.shape[1] :]
        for sign, point in ends:
            keys.append(point * n + point)
            points.append(point)
            signs.append(np.full(len(touched), sign))
            point_rows.append(row)
            rows.append(row)
        if touched.shape[1] == 2:
            keys.append(touched.min(axis=1) * n + touched.max(axis=1))
            rows.append(row)
    key, point = np.concatenate(keys), np.concatenate(points)
    order, pull_order = np.argsort(key, kind="stable"), np.argsort(point, kind="stable")
    blocks, starts = np.unique(key[order], return_index=True)
    pull_points, pull_starts = np.unique(point[pull_order], return_index=True)
    return Pattern(
        n, np.stack([blocks // n, blocks % n], axis=1), np.concatenate(rows)[order], starts,
        np.concatenate(point_rows)[pull_order], np.concatenate(signs)[pull_order][:, None], pull_starts, pull_points,
    )  # fmt: skip


def normal_equations(scheme: Pattern, linear: Linear) -> tuple[Floats, Floats]:
    """Blocks (B, P, 3, 3) of J^T J in the pattern's order and the gradient J^T r (B, n, 3)."""
    pulls = [(np.swapaxes(slope, -1, -2) @ residual[..., None])[..., 0]
             for residual, slope in zip(linear.residual, linear.slope, strict=True)]  # fmt: skip
    gradient = np.zeros((len(linear.x), scheme.points, 3))
    signed = np.concatenate(pulls, axis=1)[:, scheme.pull_rows] * scheme.pull_signs
    gradient[:, scheme.pull_points] = np.add.reduceat(signed, scheme.pull_starts, axis=1)
    return assemble(scheme, squares(linear)), gradient


def squares(linear: Linear) -> list[Floats]:
    """Per factor (B, M, 3, 3) S^T S of its whitened derivatives."""
    return [np.broadcast_to(np.swapaxes(slope, -1, -2) @ slope, (*residual.shape[:2], 3, 3))
            for residual, slope in zip(linear.residual, linear.slope, strict=True)]  # fmt: skip


def assemble(scheme: Pattern, parts: Sequence[Floats]) -> Floats:
    """Blocks (B, P, 3, 3) in the pattern's order from what each measurement adds, (B, M, 3, 3) per factor."""
    every = np.concatenate(parts, axis=1)
    gathered = every.reshape(*every.shape[:2], 9)[:, scheme.rows]
    blocks: Floats = np.add.reduceat(gathered, scheme.starts, axis=1).reshape(len(every), -1, 3, 3)
    blocks[:, scheme.pairs[:, 0] != scheme.pairs[:, 1]] *= -1.0
    return blocks
