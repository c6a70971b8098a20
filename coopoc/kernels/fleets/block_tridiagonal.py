"""Normal equations that are block-tridiagonal in time, solved forward and back on LAPACK: positions and marginals.

Matrices are in Fortran's order and of each the lower triangle counts: a step forward is a Cholesky factor and the
inverse from it, n^3 flops; a step back is a product with a vector, and for marginals a factor and two products of
triangles, 7/3 n^3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dsymv, dsyrk, dtrmm
from scipy.linalg.lapack import dpotrf, dpotri

from ...arrays import AnyArray, Floats, Ints
from ..compiling.compile import compiled
from .fleet_normal import Drive, gather

HARD = 1e7
"""Weight of the motion over that of a fix beyond which D - D S^-1 D loses its digits."""


class Memory:
    """Room for one matrix per step, used again by every sweep and run: fresh pages cost as much as what is in them.

    Args:
        sizes: (T,) rows of the largest matrix of each step.
    """

    def __init__(self, sizes: Ints) -> None:
        self.flat = np.empty((len(sizes), int(sizes.max(initial=0)) ** 2))

    def matrix(self, t: int, n: int) -> Floats:
        """(n, n) of step t."""
        return self.flat[t, : n * n].reshape(n, n).T


@dataclass(frozen=True, eq=False)
class Motion:
    """Factor between a step and the next: rows of the vehicles that stay, here and there, D 1/m^2, its gap m."""

    old: Ints
    new: Ints
    weight: Floats
    gap: Floats


def eliminate(
    drive: Drive,
    weight: Floats,
    motions: list[Motion],
    memory: Memory,
    vectors: list[Floats],
    tick: Callable[[], object],
) -> list[Floats]:
    """S^-1 of each step given the next one; `vectors` (n,) take in the past."""
    limit = HARD * drive.fix_weight[drive.fix_weight > 0].min()
    ahead = memory.matrix(0, len(vectors[0]))
    ahead[:] = 0.0
    inverses = []
    for t, (motion, eta) in enumerate(zip(motions, vectors, strict=True)):
        total = ahead
        gather(t, drive, weight, total)
        hard = motion.weight.max(initial=0.0) > limit
        known = _whole(total) if hard else total
        total[motion.old, motion.old] += motion.weight
        inverse = _inverse(total)
        inverses.append(inverse)
        ahead = memory.matrix(t + 1, len(vectors[t + 1])) if t + 1 < len(vectors) else total[:0, :0]
        if len(ahead) and hard:  # D S^-1 J is the same, and where a vehicle hardly moves D hides J
            gain = motion.weight[:, None] * (_whole(inverse)[motion.old] @ known[:, motion.old])
            ahead[:] = 0.0
            ahead[np.ix_(motion.new, motion.new)] = (gain + gain.T) / 2
            rest = motion.weight * dsymv(1.0, inverse, eta, lower=1)[motion.old]
            vectors[t + 1][motion.new] += gain @ motion.gap + rest
        elif len(ahead):
            diagonal, rows = np.zeros(len(eta)), np.full(len(eta), -1)
            diagonal[motion.old], rows[motion.old] = motion.weight, motion.new
            marginalise(inverse, rows, diagonal, ahead)
            vectors[t + 1][motion.new] += marginalised(inverse, eta, motion)
        tick()
    return inverses


def marginalised(inverse: Floats, eta: Floats, motion: Motion) -> Floats:
    """D (gap + S^-1 (eta - D gap)), the information vector of the past about the vehicles that stay."""
    if not len(eta):
        return np.zeros(0)
    less = eta.copy()
    less[motion.old] -= motion.weight * motion.gap
    return np.asarray(motion.weight * (motion.gap + dsymv(1.0, inverse, less, lower=1)[motion.old]))


def substitute(at: Floats, place: Ints, motions: list[Motion], inverses: list[Floats], eta: list[Floats]) -> Floats:
    """Positions (T, N, 3) m."""
    x = at.copy()
    error: Floats = np.zeros(0)
    for t in range(len(at) - 1, -1, -1):
        motion, one = motions[t], eta[t]
        one[motion.old] += motion.weight * (error[motion.new] - motion.gap)
        error = dsymv(1.0, inverses[t], one, lower=1) if len(one) else one
        x[t, place[t] >= 0] += error.reshape(-1, 3)
    return x


def marginals(at: Floats, place: Ints, motions: list[Motion], inverses: list[Floats]) -> Floats:
    """Covariances (T, N, 3, 3) m^2; uses up the inverses.

    Sigma_t = S^-1 + (S^-1 D C) (S^-1 D C)^T with C C^T = Sigma_{t+1}.
    """
    cov = np.full((*at.shape, 3), np.nan)
    ahead: Floats = np.zeros((0, 0))
    for t in range(len(at) - 1, -1, -1):
        sigma, motion = inverses[t], motions[t]
        if len(motion.new):
            stay = motion.new
            ahead = ahead if len(stay) == len(ahead) else np.asfortranarray(ahead[np.ix_(stay, stay)])
            mirror(sigma)
            back = (sigma.T[motion.old] * motion.weight[:, None]).T
            back = dtrmm(1.0, _cholesky(ahead), back, side=1, lower=1, overwrite_b=1)
            sigma = dsyrk(1.0, back, 1.0, sigma, lower=1, overwrite_c=1)
        ahead = sigma
        own_blocks(ahead, np.flatnonzero(place[t] >= 0), cov[t])
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
    return np.asarray(dpotri(_cholesky(matrix), lower=1, overwrite_c=1)[0]) if len(matrix) else matrix


@compiled
def marginalise(inverse: AnyArray, rows: AnyArray, diagonal: AnyArray, ahead: AnyArray) -> None:
    """Information D - D S^-1 D about the next step, zero for vehicles that join there.

    Args:
        inverse: (n, n) S^-1.
        rows: (n,) the row there of each row here, -1 for a vehicle that leaves.
        diagonal: (n,) D, zero for those.
        ahead: filled.
    """
    ahead[:] = 0.0
    for c in range(len(rows)):
        column = rows[c]
        if column >= 0:
            for r in range(c, len(rows)):
                if rows[r] >= 0:
                    ahead[rows[r], column] = -diagonal[r] * diagonal[c] * inverse[r, c]
            ahead[column, column] += diagonal[c]


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
