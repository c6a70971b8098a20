"""Forward and back through a drive whose normal equations are block-tridiagonal, on LAPACK: positions and marginals.

The smoother of `coopoc.methods.batch_smoother`. Matrices are in Fortran's order and of each the lower triangle counts:
a step forward is a Cholesky factor and the inverse from it, n^3 flops; a step back is a product with a vector, and for
marginals a factor and two products of triangles, 7/3 n^3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg.blas import dsymv, dsyrk, dtrmm
from scipy.linalg.lapack import dpotrf, dpotri

from ..arrays import AnyArray, Floats, Ints
from .compile import compiled
from .fleet_graph import gather, linearise, toward

STIFF = 1e7
"""Weight of the motion over that of a fix beyond which D - D S^-1 D is no longer the difference that it stands for."""


class Memory:
    """Room for one matrix per step, used again by every sweep and run: fresh pages cost as much as what is in them.

    Args:
        sizes: (T,) rows of each step's matrix.
    """

    def __init__(self, sizes: Ints) -> None:
        self.sizes, self.flat = sizes, np.empty((len(sizes), int(sizes.max(initial=0)) ** 2))

    def matrix(self, t: int) -> Floats:
        """(n, n) of step t."""
        n = int(self.sizes[t])
        return self.flat[t, : n * n].reshape(n, n).T


@dataclass(frozen=True, eq=False)
class Between:
    """What ties a step to the next: rows of those who stay, here and there, D of their motion 1/m^2, its gap m."""

    old: Ints
    new: Ints
    weight: Floats
    gap: Floats


def smooth(
    at: Floats, graph: Any, own: Any, steps: int, settled: Callable[[float], bool], memory: Memory,
    tick: Callable[[], object],
) -> tuple[Floats, Floats]:  # fmt: skip
    """Positions (T, N, 3) m and covariances (T, N, 3, 3) m^2 of one run, NaN where a vehicle is absent.

    Args:
        at: (T, N, 3) m to begin at. graph, own: see `fleet_graph`. steps: Gauss-Newton steps after the converted
            solution; more with the last factors until one is `settled`. tick: called once a step of each sweep.

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    stays = _stays(graph[0])
    for exact in range(steps + 1):
        ties, before = _ties(at, stays, own), at
        weight, force = linearise(at, graph, exact > 0)
        pulls = _pulls(toward(at, graph, force, own), graph[0])
        _eliminate(graph, weight, own[0], ties, memory, pulls, tick)
        at = _substitute(at, graph[0], ties, memory, pulls)
    while steps and not settled(float(np.nanmax(np.abs(at - before)))):
        moved, before = _ties(at, stays, own), at
        pulls = _pulls(toward(at, graph, linearise(at, graph, True)[1], own), graph[0])
        for t, tie in enumerate(moved[:-1]):
            pulls[t + 1][tie.new] += _handed(memory.matrix(t), pulls[t], tie)
        at = _substitute(at, graph[0], moved, memory, pulls)
    return at, _marginals(at, graph[0], ties, memory)


def _pulls(pull: Floats, place: Ints) -> list[Floats]:
    """(n,) of each step."""
    return [row[there].ravel() for row, there in zip(pull, place >= 0, strict=True)]


def _stays(place: Ints) -> list[tuple[Ints, Ints, Ints]]:
    """Columns of those who are at each step and the next, and their rows here and there."""
    found = []
    for here, there in pairwise(place):
        columns = np.flatnonzero((here >= 0) & (there >= 0))
        old, new = ((3 * rows[columns, None] + np.arange(3)).ravel() for rows in (here, there))
        found.append((columns, old, new))
    return found


def _ties(at: Floats, stays: list[tuple[Ints, Ints, Ints]], own: Any) -> list[Between]:
    """Of each step and the next; nothing after the last."""
    gap = own[3][1:] - np.diff(at, axis=0)
    ties = [Between(old, new, own[2][t + 1, columns].ravel(), gap[t, columns].ravel())
            for t, (columns, old, new) in enumerate(stays)]  # fmt: skip
    none = np.zeros(0, np.int64)
    return [*ties, Between(none, none, np.zeros(0), np.zeros(0))]


def _eliminate(
    graph: Any, weight: Floats, fix_weight: Floats, ties: list[Between], memory: Memory, pulls: list[Floats],
    tick: Callable[[], object],
) -> None:  # fmt: skip
    """Each step given the next one: S^-1 to `memory`, and to `pulls` (n,) what the past pulls."""
    memory.matrix(0)[:] = 0.0
    for t, (tie, pull) in enumerate(zip(ties, pulls, strict=True)):
        total = memory.matrix(t)
        gather(t, graph, weight, fix_weight, total)
        hard = tie.weight.max(initial=0.0) > STIFF * fix_weight.min()
        known = _whole(total) if hard else total
        total[tie.old, tie.old] += tie.weight
        inverse = _inverse(total)
        if t + 1 < len(pulls) and hard:  # D S^-1 J is the same, and where a vehicle hardly moves D hides J
            kept, ahead = tie.weight[:, None] * (_whole(inverse)[tie.old] @ known[:, tie.old]), memory.matrix(t + 1)
            ahead[:] = 0.0
            ahead[np.ix_(tie.new, tie.new)] = (kept + kept.T) / 2
            pulls[t + 1][tie.new] += kept @ tie.gap + tie.weight * dsymv(1.0, inverse, pull, lower=1)[tie.old]
        elif t + 1 < len(pulls):
            stiffness, stays = np.zeros(len(pull)), np.full(len(pull), -1)
            stiffness[tie.old], stays[tie.old] = tie.weight, tie.new
            carry(inverse, stays, stiffness, memory.matrix(t + 1))
            pulls[t + 1][tie.new] += _handed(inverse, pull, tie)
        tick()


def _handed(inverse: Floats, pull: Floats, tie: Between) -> Floats:
    """D (gap + S^-1 (pull - D gap)), what the past pulls at those who stay."""
    less = pull.copy()
    less[tie.old] -= tie.weight * tie.gap
    return np.asarray(tie.weight * (tie.gap + dsymv(1.0, inverse, less, lower=1)[tie.old]))


def _substitute(at: Floats, place: Ints, ties: list[Between], memory: Memory, pulls: list[Floats]) -> Floats:
    """Positions (T, N, 3) m."""
    x, error = at.copy(), np.zeros(0)
    for t in range(len(at) - 1, -1, -1):
        tie = ties[t]
        pulls[t][tie.old] += tie.weight * (error[tie.new] - tie.gap)
        error = dsymv(1.0, memory.matrix(t), pulls[t], lower=1)
        x[t, place[t] >= 0] += error.reshape(-1, 3)
    return x


def _marginals(at: Floats, place: Ints, ties: list[Between], memory: Memory) -> Floats:
    """Covariances (T, N, 3, 3) m^2; uses up what is in `memory`.

    Sigma_t = S^-1 + (S^-1 D C) (S^-1 D C)^T with C C^T = Sigma_{t+1}.
    """
    cov = np.full((*at.shape, 3), np.nan)
    spread: Floats = np.zeros((0, 0))
    for t in range(len(at) - 1, -1, -1):
        inverse, tie = memory.matrix(t), ties[t]
        if len(tie.new):
            kept = spread if len(tie.new) == len(spread) else np.asfortranarray(spread[np.ix_(tie.new, tie.new)])
            mirror(inverse)
            back = (inverse.T[tie.old] * tie.weight[:, None]).T
            back = dtrmm(1.0, _cholesky(kept), back, side=1, lower=1, overwrite_b=1)
            inverse = dsyrk(1.0, back, 1.0, inverse, lower=1, overwrite_c=1)
        spread = inverse
        own_blocks(spread, np.flatnonzero(place[t] >= 0), cov[t])
    return cov


def _whole(lower: Floats) -> Floats:
    """A copy with both triangles."""
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def _cholesky(matrix: Floats) -> Floats:
    """Lower factor in the matrix's place."""
    factor, wrong = dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if wrong:
        raise np.linalg.LinAlgError(f"row {wrong} of the normal equations is not positive definite")
    return np.asarray(factor)


def _inverse(matrix: Floats) -> Floats:
    """Lower triangle of the inverse in the matrix's place."""
    return np.asarray(dpotri(_cholesky(matrix), lower=1, overwrite_c=1)[0])


@compiled
def carry(inverse: AnyArray, stays: AnyArray, stiffness: AnyArray, ahead: AnyArray) -> None:
    """Information D - D S^-1 D that a step hands to the next, zero for those who join there.

    Args:
        stays: (n,) the row there of each row here, -1 for who leaves. stiffness: (n,) D, zero for those.
    """
    ahead[:] = 0.0
    for c in range(len(stays)):
        column = stays[c]
        if column >= 0:
            for r in range(c, len(stays)):
                if stays[r] >= 0:
                    ahead[stays[r], column] = -stiffness[r] * stiffness[c] * inverse[r, c]
            ahead[column, column] += stiffness[c]


@compiled
def mirror(lower: AnyArray) -> None:
    """Upper triangle from the lower one, tile by tile."""
    n, tile = len(lower), 16
    for left in range(0, n, tile):
        for top in range(left, n, tile):
            for c in range(left, min(left + tile, n)):
                for r in range(max(top, c + 1), min(top + tile, n)):
                    lower[c, r] = lower[r, c]


@compiled
def own_blocks(lower: AnyArray, columns: AnyArray, cov: AnyArray) -> None:
    """Diagonal blocks (3, 3) of (n, n) into the columns of `cov` (N, 3, 3)."""
    for k in range(len(columns)):
        for c in range(3):
            for r in range(c, 3):
                value = lower[3 * k + r, 3 * k + c]
                cov[columns[k], r, c] = value
                cov[columns[k], c, r] = value
