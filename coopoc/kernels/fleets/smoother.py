"""Gauss-Newton smoother of a whole drive of a fleet: normal equations that are block-tridiagonal in time, on LAPACK.

Matrices are in Fortran's order and of each the lower triangle counts: a step forward is a Cholesky factor and the
inverse from it, n^3 flops; a step back is a product with a vector, and for marginals a factor and two products of
triangles, 7/3 n^3.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dsymv, dsyrk, dtrmm
from scipy.linalg.lapack import dpotrf, dpotri

from ...arrays import Bools, Floats, Ints
from ..compiling.compile import compiled
from ..compiling.small import add_diagonal, load, store, subtract
from .graph import MATRIX, VECTOR, Assumed, Measured, Pairs, gate_pair, pair

HARD = 1e7
"""Weight of the motion over that of a fix beyond which D - D S^-1 D loses its digits."""
SLACK = 0.5
"""Variance of the difference of two own filters over that of a fix, where the weights are set first."""
EXTRA, HALVINGS = 20, 12
"""Sweeps beyond the asked ones while steps must be shortened, and how often one is halved."""


class RunFactors(NamedTuple):
    """The factors of one run.

    Attributes:
        active: (T, N).
        row: (T, N) the vehicle's number among those of its step, -1 where inactive.
        pairs: those that count; `alive` is (1, P).
        relative: (L, 8), the last three the factors of the standard deviations.
        assumed: the noise model.
        fix_weight: (T, N, 3) 1/m^2, 0 where there is no fix.
        fix: (T, N, 3) m, any number where there is none.
        motion_weight: (T, N, 3) 1/m^2 of the motion from the step before.
        motion: (T, N, 3) m.
    """

    active: Bools
    row: Ints
    pairs: Pairs
    relative: Floats
    assumed: Assumed
    fix_weight: Floats
    fix: Floats
    motion_weight: Floats
    motion: Floats


class Motion(NamedTuple):
    """Factor between a step and the next: rows of the vehicles that stay, here and there, D 1/m^2, its gap m."""

    old: Ints
    new: Ints
    weight: Floats
    gap: Floats


def run_factors(measured: Measured, pairs: Pairs, assumed: Assumed) -> RunFactors:
    """The factors of arguments of one run."""
    active, gnss = measured.active[0], measured.gnss[0]
    row = np.where(active, np.cumsum(active, axis=1) - 1, -1)
    fix_weight: Floats = np.where(np.isnan(gnss), 0.0, 1.0 / np.broadcast_to(assumed.fix, measured.gnss.shape)[0])
    motion_weight = np.broadcast_to(1.0 / assumed.process, measured.gnss.shape)[0]
    motion = measured.dt * measured.velocity[0]
    fix = np.nan_to_num(gnss)
    return RunFactors(active, row, pairs, measured.relative[0], assumed, fix_weight, fix, motion_weight, motion)


def smooth(
    x: Floats, factors: RunFactors, steps: int, settle: float, tick: Callable[[], object]
) -> tuple[Floats, Floats, bool]:
    """Positions (T, N, 3) m and covariances (T, N, 3, 3) m^2 of one run, NaN where a vehicle is inactive; whether the
    last step was small.

    Args:
        x: (T, N, 3) m to begin at.
        factors: its measurements.
        steps: Gauss-Newton steps after the converted solution; more with the last normal equations until one is small,
            or no smaller than the one before.
        settle: m, the largest step that is small; inf stops after `steps`.
        tick: called once a step of each sweep.

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    sweeps, whole, last = 0, False, np.inf
    slack = SLACK / float(factors.fix_weight[factors.fix_weight > 0].mean())
    while True:
        moving, before = motions(x, factors), x
        weight, eta = linearise(x, factors, sweeps == 0, sweeps <= steps, slack if sweeps == 0 else 0.0)
        vectors = [row[there].ravel() for row, there in zip(sum_vectors(x, factors, eta), factors.active, strict=True)]
        if sweeps <= steps or not whole:
            eliminated, inverses = moving, eliminate(factors, weight, moving, vectors, tick)
            sweeps += 1
        else:
            for t, motion in enumerate(moving[:-1]):
                vectors[t + 1][motion.new] += marginalised(inverses[t], vectors[t], motion)
        x = substitute(x, factors.active, moving, inverses, vectors)
        if sweeps > 1:
            x, whole = descended(before, x, factors)
        if sweeps <= steps:
            continue
        size = float(np.nanmax(np.abs(x - before))) if whole or sweeps <= steps + EXTRA else np.inf
        small = not steps or settle == np.inf or size <= settle
        if not steps or ((whole or size == np.inf) and (small or not size < last)):
            return x, marginals(x, factors.active, eliminated, inverses), small
        if whole or size == np.inf:
            last = size


def descended(before: Floats, after: Floats, factors: RunFactors) -> tuple[Floats, bool]:
    """The step from `before` to `after`, halved until it does not raise the cost, and whether it is whole."""
    cost = misfit(before, factors)
    for k in range(HALVINGS):
        shorter = before + 0.5**k * (after - before)
        if misfit(shorter, factors) <= cost * (1.0 + 1e-12):
            return shorter, k == 0
    return before, False


def misfit(x: Floats, factors: RunFactors) -> float:
    """Sum of the squared whitened residuals of fixes, motions, ranges and angles at positions (T, N, 3) m."""
    pairs, total = factors.pairs, float(np.nansum(factors.fix_weight * (factors.fix - x) ** 2))
    total += float(np.nansum(factors.motion_weight[1:] * (factors.motion[1:] - np.diff(x, axis=0)) ** 2))
    step = np.repeat(np.arange(len(x)), np.diff(pairs.start))
    gap = x[step, pairs.second] - x[step, pairs.first]
    for link, vector in ((pairs.link, gap), (pairs.link_back, -gap)):
        used = pairs.alive[0] & (link >= 0)
        seen, (east, north, up) = factors.relative[link[used]].T, vector[used].T
        std = factors.assumed.std[:, None] * seen[5:]
        flat = np.hypot(east, north)
        apart = [
            np.where(seen[0] >= 0.0, seen[0] - np.hypot(flat, up), 0.0),
            np.arctan2(seen[1] * east - seen[2] * north, seen[2] * east + seen[1] * north),
            np.arctan2(seen[3] * up - seen[4] * flat, seen[4] * up + seen[3] * flat),
        ]
        total += float(np.sum((np.stack(apart) / std) ** 2))
    return total


def motions(x: Floats, factors: RunFactors) -> list[Motion]:
    """The factors between each step and the next; nothing after the last."""
    gap, found = factors.motion[1:] - np.diff(x, axis=0), []
    for t, (here, there) in enumerate(pairwise(factors.row)):
        columns = np.flatnonzero((here >= 0) & (there >= 0))
        old, new = ((3 * rows[columns, None] + np.arange(3)).ravel() for rows in (here, there))
        found.append(Motion(old, new, factors.motion_weight[t + 1, columns].ravel(), gap[t, columns].ravel()))
    none = np.zeros(0, np.int64)
    return [*found, Motion(none, none, np.zeros(0), np.zeros(0))]


def eliminate(
    factors: RunFactors, weight: Floats, motions: list[Motion], vectors: list[Floats], tick: Callable[[], object]
) -> list[Floats]:
    """S^-1 of each step given the next one; `vectors` (n,) take in the past."""
    limit = HARD * factors.fix_weight[factors.fix_weight > 0].min()
    total, inverses = np.zeros((len(vectors[0]), len(vectors[0])), order="F"), []
    for t, (motion, eta) in enumerate(zip(motions, vectors, strict=True)):
        add_information(t, factors, weight, total)
        hard = motion.weight.max(initial=0.0) > limit
        prior = both_triangles(total) if hard else total
        total[motion.old, motion.old] += motion.weight
        inverse = np.asarray(dpotri(cholesky(total), lower=1, overwrite_c=1)[0]) if len(total) else total
        inverses.append(inverse)
        size = len(vectors[t + 1]) if t + 1 < len(vectors) else 0
        total = np.zeros((size, size), order="F")
        if size and hard:  # D S^-1 J is the same, and where a vehicle hardly moves D hides J
            gain = motion.weight[:, None] * (both_triangles(inverse)[motion.old] @ prior[:, motion.old])
            total[np.ix_(motion.new, motion.new)] = (gain + gain.T) / 2
            rest = motion.weight * dsymv(1.0, inverse, eta, lower=1)[motion.old]
            vectors[t + 1][motion.new] += gain @ motion.gap + rest
        elif size and len(motion.old):
            marginalise(inverse, motion, total)
            vectors[t + 1][motion.new] += marginalised(inverse, eta, motion)
        tick()
    return inverses


@compiled
def marginalise(inverse: Floats, motion: Motion, total: Floats) -> None:
    """Information D - D S^-1 D about the next step."""
    for c in range(len(motion.old)):
        for r in range(c, len(motion.old)):
            value = motion.weight[r] * motion.weight[c] * inverse[motion.old[r], motion.old[c]]
            total[motion.new[r], motion.new[c]] = -value
        total[motion.new[c], motion.new[c]] += motion.weight[c]


def marginalised(inverse: Floats, eta: Floats, motion: Motion) -> Floats:
    """D (gap + S^-1 (eta - D gap)), the information vector of the past about the vehicles that stay."""
    if not len(eta):
        return np.zeros(0)
    less = eta.copy()
    less[motion.old] -= motion.weight * motion.gap
    return np.asarray(motion.weight * (motion.gap + dsymv(1.0, inverse, less, lower=1)[motion.old]))


def substitute(
    x: Floats, active: Bools, motions: list[Motion], inverses: list[Floats], vectors: list[Floats]
) -> Floats:
    """Positions (T, N, 3) m."""
    x, error = x.copy(), vectors[-1][:0]
    for t in range(len(x) - 1, -1, -1):
        motion, eta = motions[t], vectors[t]
        eta[motion.old] += motion.weight * (error[motion.new] - motion.gap)
        error = dsymv(1.0, inverses[t], eta, lower=1) if len(eta) else eta
        x[t, active[t]] += error.reshape(-1, 3)
    return x


def marginals(x: Floats, active: Bools, motions: list[Motion], inverses: list[Floats]) -> Floats:
    """Covariances (T, N, 3, 3) m^2; uses up the inverses.

    Sigma_t = S^-1 + (S^-1 D C) (S^-1 D C)^T with C C^T = Sigma_{t+1}.
    """
    cov: Floats = np.full((*x.shape, 3), np.nan)
    ahead: Floats = np.zeros((0, 0))
    for t in range(len(x) - 1, -1, -1):
        sigma, motion = inverses[t], motions[t]
        if len(motion.new):
            if len(motion.new) < len(ahead):
                ahead = np.asfortranarray(ahead[np.ix_(motion.new, motion.new)])
            back = np.asfortranarray(both_triangles(sigma)[:, motion.old] * motion.weight)
            back = dtrmm(1.0, cholesky(ahead), back, side=1, lower=1, overwrite_b=1)
            sigma = dsyrk(1.0, back, 1.0, sigma, lower=1, overwrite_c=1)
        ahead, n = sigma, len(sigma) // 3
        lower = np.tril(sigma.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)])
        cov[t, active[t]] = lower + np.tril(lower, -1).swapaxes(1, 2)
    return cov


def both_triangles(lower: Floats) -> Floats:
    """The symmetric matrix of a lower triangle."""
    return np.tril(lower) + np.tril(lower, -1).T


def cholesky(matrix: Floats) -> Floats:
    """Lower factor in the matrix's place."""
    factor, wrong = dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if wrong:
        raise np.linalg.LinAlgError(f"row {wrong} of the normal equations is not positive definite")
    return np.asarray(factor)


@compiled
def linearise(x: Floats, factors: RunFactors, converted: bool, gates: bool, variance: float) -> tuple[Floats, Floats]:
    """Information (9 P) of each pair and its information vector (P, 3) at positions (T, N, 3) m.

    Args:
        x: m.
        factors: of the run.
        converted: measurements linear in the vector.
        gates: set the factors of their deviations, if robust.
        variance: m^2, of the difference of two positions, for gates.
    """
    pairs, cov = factors.pairs, add_diagonal(MATRIX, (variance, variance, variance))
    weight, eta = np.zeros(9 * len(pairs.first)), np.zeros((len(pairs.first), 3))
    for t in range(len(x)):
        for k in range(pairs.start[t], pairs.start[t + 1]):
            if pairs.alive[0, k]:
                vector = subtract(load(x[t, pairs.second[k]], 0, VECTOR), load(x[t, pairs.first[k]], 0, VECTOR))
                if gates and factors.assumed.robust:
                    gate_pair(vector, cov, k, pairs, factors.relative, factors.assumed)
                information, pair_eta = pair(vector, k, pairs, factors.relative, factors.assumed, converted)
                store(weight, k, information)
                store(eta[k], 0, pair_eta)
    return weight, eta


@compiled
def add_information(t: int, factors: RunFactors, weight: Floats, total: Floats) -> None:
    """Add the information of the fixes and pairs of step t to its matrix (n, n)."""
    for column in range(factors.row.shape[1]):
        a = 3 * factors.row[t, column]
        for c in range(3 if a >= 0 else 0):
            total[a + c, a + c] += factors.fix_weight[t, column, c]
    pairs = factors.pairs
    for k in range(pairs.start[t], pairs.start[t + 1]):
        a, b = 3 * factors.row[t, pairs.first[k]], 3 * factors.row[t, pairs.second[k]]
        for c in range(3 if pairs.alive[0, k] else 0):
            for r in range(3):
                total[b + r, a + c] -= weight[9 * k + 3 * r + c]
                if r >= c:
                    total[a + r, a + c] += weight[9 * k + 3 * r + c]
                    total[b + r, b + c] += weight[9 * k + 3 * r + c]


def sum_vectors(x: Floats, factors: RunFactors, eta: Floats) -> Floats:
    """(T, N, 3) 1/m, information vectors of fixes and pairs at every position."""
    pairs, total = factors.pairs, factors.fix_weight * (factors.fix - x)
    step = np.repeat(np.arange(len(x)), np.diff(pairs.start))
    np.subtract.at(total, (step, pairs.first), eta)
    np.add.at(total, (step, pairs.second), eta)
    return total
