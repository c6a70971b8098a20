"""Forward and back through a drive whose normal equations are block-tridiagonal, on LAPACK: positions and marginals.

The smoother of `coopoc.methods.batch_smoother`. Matrices are in Fortran's order and of each the lower triangle counts:
a step forward is a Cholesky factor and the inverse from it, n^3 flops; a step back is a product with a vector, and for
marginals a factor and two products of triangles, 7/3 n^3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dsymv, dsyrk, dtrmm
from scipy.linalg.lapack import dpotrf, dpotri

from ..arrays import AnyArray, Floats, Ints
from .compile import compiled
from .fleet_graph import VECTOR, Assumed, Measured, Pairs, advance, pair
from .small import load, store, subtract

HARD = 1e7
"""Weight of the motion over that of a fix beyond which D - D S^-1 D loses its digits."""


EXTRA, HALVINGS = 20, 12
"""Sweeps beyond the asked ones while steps must be shortened, and how often one is halved."""


class Drive(NamedTuple):
    """One run.

    Attributes:
        place: (T, N) the vehicle's number among those of its step, -1 where inactive.
        pairs: those that count; `alive` is (1, P).
        relative: (L, 5).
        assumed: the noise model.
        fix_weight: (T, N, 3) 1/m^2, 0 where there is no fix.
        fix: (T, N, 3) m, any number where there is none.
        motion_weight: (T, N, 3) 1/m^2 of the motion from the step before.
        motion: (T, N, 3) m.
    """

    place: AnyArray
    pairs: Pairs
    relative: AnyArray
    assumed: Assumed
    fix_weight: AnyArray
    fix: AnyArray
    motion_weight: AnyArray
    motion: AnyArray


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


def smooth(
    at: Floats, drive: Drive, steps: int, settled: Callable[[float], bool], memory: Memory, tick: Callable[[], object]
) -> tuple[Floats, Floats]:
    """Positions (T, N, 3) m and covariances (T, N, 3, 3) m^2 of one run, NaN where a vehicle is inactive.

    Args:
        at: (T, N, 3) m to begin at.
        drive: its measurements.
        steps: Gauss-Newton steps after the converted solution; more with the last factors until one is `settled`.
        settled: whether to stop after a step that moved some position by so many metres.
        memory: of the factors.
        tick: called once a step of each sweep.

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    stays = _stays(drive.place)
    sweeps, whole = 0, False
    while True:
        moved, before = _motions(at, stays, drive), at
        weight, eta = linearise(at, drive, sweeps == 0)
        vectors = _vectors(sum_vectors(at, drive, eta), drive.place)
        if sweeps <= steps or not whole:
            motions, inverses = moved, _eliminate(drive, weight, moved, memory, vectors, tick)
            sweeps += 1
        else:
            for t, motion in enumerate(moved[:-1]):
                vectors[t + 1][motion.new] += _marginalised(inverses[t], vectors[t], motion)
        at = _substitute(at, drive.place, moved, inverses, vectors)
        if sweeps > 1:
            at, whole = descended(before, at, drive)
        size = float(np.nanmax(np.abs(at - before))) if whole or sweeps <= steps + EXTRA else np.inf
        if sweeps > steps and (not steps or ((whole or size == np.inf) and settled(size))):
            return at, _marginals(at, drive.place, motions, inverses)


def descended(before: Floats, at: Floats, drive: Drive) -> tuple[Floats, bool]:
    """The step from `before` to `at`, halved until it does not raise the cost, and whether it is whole."""
    cost = misfit(before, drive)
    for k in range(HALVINGS):
        shorter = before + 0.5**k * (at - before)
        if misfit(shorter, drive) <= cost * (1.0 + 1e-12):
            return shorter, k == 0
    return before, False


def misfit(at: Floats, drive: Drive) -> float:
    """Sum of the squared whitened residuals of fixes, motions, ranges and angles at positions (T, N, 3) m."""
    pairs, total = drive.pairs, float(np.nansum(drive.fix_weight * (drive.fix - at) ** 2))
    total += float(np.nansum(drive.motion_weight[1:] * (drive.motion[1:] - np.diff(at, axis=0)) ** 2))
    step = np.repeat(np.arange(len(at)), np.diff(pairs.start))
    gap = at[step, pairs.second] - at[step, pairs.first]
    for link, vector in ((pairs.link, gap), (pairs.link_back, -gap)):
        used = pairs.alive[0] & (link >= 0)
        seen, (x, y, z) = drive.relative[link[used]], vector[used].T
        flat = np.hypot(x, y)
        apart = np.stack(
            [
                np.where(seen[:, 0] >= 0.0, seen[:, 0] - np.hypot(flat, z), 0.0),
                np.arctan2(seen[:, 1] * x - seen[:, 2] * y, seen[:, 2] * x + seen[:, 1] * y),
                np.arctan2(seen[:, 3] * z - seen[:, 4] * flat, seen[:, 4] * z + seen[:, 3] * flat),
            ]
        )
        total += float(np.sum((apart / drive.assumed.std[:, None]) ** 2))
    return total


def _vectors(eta: Floats, place: Ints) -> list[Floats]:
    """(n,) of each step."""
    return [row[there].ravel() for row, there in zip(eta, place >= 0, strict=True)]


def _stays(place: Ints) -> list[tuple[Ints, Ints, Ints]]:
    """Columns of the vehicles present at each step and the next, and their rows here and there."""
    found = []
    for here, there in pairwise(place):
        columns = np.flatnonzero((here >= 0) & (there >= 0))
        old, new = ((3 * rows[columns, None] + np.arange(3)).ravel() for rows in (here, there))
        found.append((columns, old, new))
    return found


def _motions(at: Floats, stays: list[tuple[Ints, Ints, Ints]], drive: Drive) -> list[Motion]:
    """Of each step and the next; nothing after the last."""
    gap = drive.motion[1:] - np.diff(at, axis=0)
    motions = [
        Motion(old, new, drive.motion_weight[t + 1, columns].ravel(), gap[t, columns].ravel())
        for t, (columns, old, new) in enumerate(stays)
    ]
    none = np.zeros(0, np.int64)
    return [*motions, Motion(none, none, np.zeros(0), np.zeros(0))]


def _eliminate(
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
            vectors[t + 1][motion.new] += _marginalised(inverse, eta, motion)
        tick()
    return inverses


def _marginalised(inverse: Floats, eta: Floats, motion: Motion) -> Floats:
    """D (gap + S^-1 (eta - D gap)), the information vector of the past about the vehicles that stay."""
    if not len(eta):
        return np.zeros(0)
    less = eta.copy()
    less[motion.old] -= motion.weight * motion.gap
    return np.asarray(motion.weight * (motion.gap + dsymv(1.0, inverse, less, lower=1)[motion.old]))


def _substitute(at: Floats, place: Ints, motions: list[Motion], inverses: list[Floats], eta: list[Floats]) -> Floats:
    """Positions (T, N, 3) m."""
    x = at.copy()
    error: Floats = np.zeros(0)
    for t in range(len(at) - 1, -1, -1):
        motion, one = motions[t], eta[t]
        one[motion.old] += motion.weight * (error[motion.new] - motion.gap)
        error = dsymv(1.0, inverses[t], one, lower=1) if len(one) else one
        x[t, place[t] >= 0] += error.reshape(-1, 3)
    return x


def _marginals(at: Floats, place: Ints, motions: list[Motion], inverses: list[Floats]) -> Floats:
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
def alone(measured: Measured, assumed: Assumed) -> Floats:
    """Positions (R, T, 3 N) m of each vehicle's own filter, NaN where inactive."""
    runs, steps, vehicles = measured.active.shape
    x, own = np.empty((runs, steps, 3 * vehicles)), np.zeros(9 * vehicles)
    for run in range(runs):
        for t in range(steps):
            advance(run, t, x[run], own, measured, assumed)
    return x


@compiled
def linearise(at: AnyArray, drive: Drive, converted: bool) -> tuple[Floats, Floats]:
    """Information (9 P) of each pair and its information vector (P, 3) at positions (T, N, 3) m."""
    pairs = drive.pairs
    weight, eta = np.zeros(9 * len(pairs.first)), np.zeros((len(pairs.first), 3))
    for t in range(len(at)):
        for k in range(pairs.start[t], pairs.start[t + 1]):
            if pairs.alive[0, k]:
                vector = subtract(load(at[t, pairs.second[k]], 0, VECTOR), load(at[t, pairs.first[k]], 0, VECTOR))
                one = pair(vector, k, pairs, drive.relative, drive.assumed, converted)
                store(weight, k, one[0])
                store(eta[k], 0, one[1])
    return weight, eta


@compiled
def gather(t: int, drive: Drive, weight: AnyArray, total: AnyArray) -> None:
    """Add the information of the fixes and pairs of step t to its matrix (n, n)."""
    for column in range(drive.place.shape[1]):
        a = 3 * drive.place[t, column]
        for c in range(3 if a >= 0 else 0):
            total[a + c, a + c] += drive.fix_weight[t, column, c]
    pairs = drive.pairs
    for k in range(pairs.start[t], pairs.start[t + 1]):
        a, b = 3 * drive.place[t, pairs.first[k]], 3 * drive.place[t, pairs.second[k]]
        for c in range(3 if pairs.alive[0, k] else 0):
            for r in range(3):
                total[b + r, a + c] -= weight[9 * k + 3 * r + c]
                if r >= c:
                    total[a + r, a + c] += weight[9 * k + 3 * r + c]
                    total[b + r, b + c] += weight[9 * k + 3 * r + c]


@compiled
def sum_vectors(at: AnyArray, drive: Drive, eta: AnyArray) -> Floats:
    """(T, N, 3) 1/m, information vectors of fixes and pairs at every position."""
    pairs = drive.pairs
    total: Floats = drive.fix_weight * (drive.fix - at)
    for t in range(len(at)):
        for k in range(pairs.start[t], pairs.start[t + 1]):
            for c in range(3 if pairs.alive[0, k] else 0):
                total[t, pairs.first[k], c] -= eta[k, c]
                total[t, pairs.second[k], c] += eta[k, c]
    return total


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
