"""NEES of a track, e^T P^-1 e by P = L D L^T, covariances that are none, and what contradicts a track, in one pass
each."""

from math import isfinite, isnan

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled
from .compiling.small import add, block_at, normalised_square, scale, subtract, times, vector_at
from .gate import FIX_GATE, HARD_REJECT_FACTOR
from .geometry import direction, five, residuals, with_std
from .stars.gaussian import distance
from .stars.messages import BLOCK, ROW, three_of

MAX_CORRELATION2 = 1.0 + 1e-9
"""A squared covariance over the product of its variances, at most, with what rounding adds."""
JUDGED_IN_A_ROW, DOUBT = 5, 36.0
"""Numbers in a row that are judged together: they contradict the track where all are beyond FIX_GATE, those of
neighbours beyond HARD_REJECT_FACTOR times it; and the squared normalised mean of such a row, of three degrees of
freedom, that chance does not reach."""


@compiled
def unsound(cov: Floats) -> int:
    """Number of covariances (n, 3, 3) that are not finite, symmetric and positive semidefinite to a share of 1e-9."""
    count = 0
    for p in cov:
        a, b, c, d, e, f = p[0, 0], p[1, 1], p[2, 2], p[1, 0], p[2, 0], p[2, 1]
        skew = max(abs(p[0, 1] - d), abs(p[0, 2] - e), abs(p[1, 2] - f))
        det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
        sides = (
            d * d <= MAX_CORRELATION2 * a * b
            and e * e <= MAX_CORRELATION2 * a * c
            and f * f <= MAX_CORRELATION2 * b * c
        )
        sound = sides and a >= 0.0 and b >= 0.0 and c >= 0.0 and det >= (1.0 - MAX_CORRELATION2) * a * b * c
        if not (sound and skew <= (MAX_CORRELATION2 - 1.0) * max(a, b, c) and isfinite(a + b + c)):
            count += 1
    return count


@compiled
def normalised(x: Floats, truth: Floats, cov: Floats) -> Floats:
    """e^T P^-1 e (R, T, E) by P = L D L^T, NaN where P is zero or the truth is unknown, infinite where another P has
    no inverse, but for a height without error."""
    squares = np.empty(x.shape[0] * x.shape[1] * x.shape[2])
    for i in range(len(squares)):
        p, error = block_at(cov, i), subtract(vector_at(x, i), vector_at(truth, i % (truth.size // 3)))
        squares[i] = distance(p, error)[0]
        if not isfinite(squares[i]):
            squares[i] = np.nan if isnan(error[0]) or p == BLOCK else np.inf
    return squares.reshape(x.shape[:3])


@compiled
def mark_estimates(gnss: Floats, x: Floats, cov: Floats, columns: Ints, fix: Floats, every: int, marks: Ints) -> Floats:
    """Mark where JUDGED_IN_A_ROW successive fixes contradict estimates. Returns the largest squared normalised
    difference of each vehicle (R, E).

    Args:
        gnss: (R, T, N, 3) m, NaN for no fix.
        x: (R, T, E, 3) m.
        cov: (R, T, E, 3, 3) m^2, or of no length.
        columns: (E,) of the vehicles.
        fix: (T, N, 2, 3) m^2, variances of a fix, what is white and what lasts.
        every: steps from one fix to the next, at least.
        marks: (2 or more, E, T) out, 1 where fixes are far, or else contradict covariances.
    """
    runs, steps = gnss.shape[:2]
    worst = np.zeros((runs, len(columns)))
    for run in range(runs):
        for k in range(len(columns)):
            count, far, mean, first, t, r, p = 0, 0, 0.0, 0, 0, ROW, ROW
            while t < steps:
                now, t = t, t + 1
                gap = subtract(three_of(gnss, run, now, columns[k]), three_of(x, run, now, k))
                if isnan(gap[0]):
                    continue
                white, lasts = three_of(fix, now, columns[k], 0), three_of(fix, now, columns[k], 1)
                own = ROW
                if len(cov) > 0:
                    own = cov[run, now, k, 0, 0], cov[run, now, k, 1, 1], cov[run, now, k, 2, 2]
                q = normalised_square(gap, add(add(white, lasts), own))
                first, t = now if count == 0 else first, now + every
                r, p = add(r, gap), add(add(p, own), add(scale(white, 1.0 / JUDGED_IN_A_ROW), lasts))
                count, far, mean = count + 1, far + int(q > FIX_GATE), mean + 2.0 * q / JUDGED_IN_A_ROW
                if count == JUDGED_IN_A_ROW:
                    mean = max(mean, normalised_square(r, p) / JUDGED_IN_A_ROW)
                    worst[run, k] = max(worst[run, k], mean)
                    kind = int(far < JUDGED_IN_A_ROW)
                    if kind == 0 or (len(cov) > 0 and mean > DOUBT):
                        marks[kind, k, first:t] = 1
                    count, far, mean, r, p = 0, 0, 0.0, ROW, ROW
    return worst


@compiled
def mark_neighbours(
    gnss: Floats,
    relative: Floats,
    x: Floats,
    cov: Floats,
    neighbours: Floats,
    links: Ints,
    fix: Floats,
    std: Floats,
    every: int,
    marks: Ints,
) -> None:
    """Mark where JUDGED_IN_A_ROW messages or relative measurements of a neighbour are all far from estimates.

    Args:
        gnss: (R, T, N, 3) m.
        relative: (R, L, 3) m, rad, rad, NaN for none.
        x: (R, T, 3) m, estimates of the ego.
        cov: (R, T, 3, 3) m^2.
        neighbours: (R, M, 3) m, estimates by link of the ego.
        links: (M, 3) in time order: index among all L, step and neighbour of each.
        fix: as of `mark_estimates`.
        std: (3,) m, rad, rad.
        every: steps from one to the next, at least.
        marks: (2, N, T) out, 1 where they are far: messages, relative measurements.
    """
    for run in range(len(gnss)):
        counts = np.zeros((gnss.shape[2], 5), np.int64)
        for i in range(len(links)):
            link, t, j = links[i]
            there, lasts, p = vector_at(neighbours[run, i], 0), three_of(fix, t, j, 1), cov[run, t]
            gap, own = subtract(there, vector_at(x[run, t], 0)), (p[0, 0] + p[1, 1] + p[2, 2] + sum(lasts)) / 3.0
            if t < counts[j, 0] or isnan(gap[0]):
                continue
            polar = direction(gap)
            measured = with_std(five(relative[run, link, 0], relative[run, link, 1], relative[run, link, 2]), std)
            lengths = 1.0, polar[0] * polar[3], polar[0]
            noise, wide = times(measured[5:], lengths), (own, own, own)
            q = normalised_square(times(residuals(measured, polar), lengths), add(times(noise, noise), wide))
            own += std[0] ** 2 + (polar[0] * std[1]) ** 2
            wide = add(add(three_of(fix, t, j, 0), lasts), (own, own, own))
            message = normalised_square(subtract(three_of(gnss, run, t, j), there), wide)
            counts[j, 2] = t if counts[j, 1] == 0 else counts[j, 2]
            counts[j, 0], counts[j, 1] = t + every, counts[j, 1] + 1
            counts[j, 3] += message > HARD_REJECT_FACTOR * FIX_GATE
            counts[j, 4] += q > HARD_REJECT_FACTOR * FIX_GATE
            if counts[j, 1] == JUDGED_IN_A_ROW:
                for kind in range(2):
                    if counts[j, 3 + kind] == JUDGED_IN_A_ROW:
                        marks[kind, j, counts[j, 2] : t + every] = 1
                    counts[j, 3 + kind] = 0
                counts[j, 1] = 0
