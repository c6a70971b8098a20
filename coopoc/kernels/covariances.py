"""NEES of a track, e^T P^-1 e by P = L D L^T, covariances that are none, and what contradicts a track, in one pass
each."""

from __future__ import annotations

import math

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, part
from .geometry import direction, five, metres, residuals, with_std

LIMIT = 1.0 + 1e-9
"""A squared covariance over the product of its variances, at most, with what rounding adds."""
TOGETHER, BEYOND, DOUBT = 5, 24.0, 36.0
"""Numbers that are judged together; the squared normalised residual that each of them exceeds where all are far; and
the square of their normalised mean, of three degrees of freedom, that chance does not reach."""
FAR, SURE, SLIPS = 1, 2, 4
"""Marks of steps: numbers are far from estimates, contradict their covariances, or contradict the odometer."""


@compiled
def unsound(cov: Floats) -> int:
    """Number of covariances (n, 3, 3) that are not finite, symmetric and positive semidefinite to a share of 1e-9."""
    found = 0
    for p in cov:
        a, b, c, d, e, f = p[0, 0], p[1, 1], p[2, 2], p[1, 0], p[2, 0], p[2, 1]
        skew = max(abs(p[0, 1] - d), abs(p[0, 2] - e), abs(p[1, 2] - f))
        det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
        sides = d * d <= LIMIT * a * b and e * e <= LIMIT * a * c and f * f <= LIMIT * b * c
        sound = sides and a >= 0.0 and b >= 0.0 and c >= 0.0 and det >= (1.0 - LIMIT) * a * b * c
        if not (sound and skew <= (LIMIT - 1.0) * max(a, b, c) and math.isfinite(a + b + c)):
            found += 1
    return found


@part
def less(a: Floats, b: Floats) -> tuple[float, float, float]:
    """a - b, three numbers."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def normalised(x: Floats, truth: Floats, cov: Floats) -> tuple[Floats, bool]:
    """e^T P^-1 e (R, T, E) by P = L D L^T, NaN where P is zero or the truth is unknown, and whether every other
    P could be inverted, but for a height without error."""
    found, sound = np.empty(x.shape[:3]), True
    for run in range(len(x)):
        for t in range(x.shape[1]):
            for e in range(x.shape[2]):
                p = cov[run, t, e]
                a, b, c = less(x[run, t, e], truth[t, e])
                first, second = p[0, 1] / p[0, 0], p[0, 2] / p[0, 0]
                yy, yz, zz = p[1, 1] - first * p[0, 1], p[1, 2] - first * p[0, 2], p[2, 2] - second * p[0, 2]
                third, b = yz / yy, b - first * a
                zz, c = zz - third * yz, c - second * a - third * b
                value = a * a / p[0, 0] + b * b / yy + (c * c / zz if c != 0.0 else 0.0)
                if not math.isfinite(value):
                    sound &= math.isnan(a) or not p.any()
                    value = np.nan
                found[run, t, e] = value
    return found, sound


@compiled
def mark_fixes(
    gnss: Floats,
    velocity: Floats,
    x: Floats,
    cov: Floats,
    columns: Ints,
    noise: Floats,
    every: int,
    dt: float,
    marks: Ints,
) -> None:
    """Mark where TOGETHER fixes, one after the other, contradict estimates (R, T, E, 3) m or the odometer.

    Args:
        gnss: (R, T, N, 3) m, NaN for no fix.
        velocity: (R, T, N, 3) m/s in the same frame, or of no length.
        x: estimates.
        cov: (R, T, E, 3, 3) m^2, or of no length.
        columns: (E,) of the vehicles.
        noise: (3, 3) variances of a fix m^2, what is white and what lasts, and of a velocity, relative and least.
        every: steps from one fix to the next, at least.
        dt: s.
        marks: (E, T) out, sums of FAR, SURE and SLIPS.
    """
    moved, r, p, e, last = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for run in range(gnss.shape[0]):
        for k in range(len(columns)):
            at, before, count, far, total, first, begin, t = columns[k], -1, 0, 0, 0.0, 0, -1, 0
            walk, old = 0.0, 0.0
            moved[:], r[:], p[:], e[:] = 0.0, 0.0, 0.0, 0.0
            while t < gnss.shape[1]:
                there, q, span, middle = not math.isnan(gnss[run, t, at, 0]), 0.0, dt * (t - before), (before + t) // 2
                if there and count == 0:
                    first = t
                for c in range(3):
                    if before >= 0 and len(velocity) > 0:
                        u = velocity[run, middle + (before + t) % 2, at, c] + velocity[run, middle + 1, at, c]
                        moved[c] += 0.5 * span * u
                        walk += span * span * (0.25 * noise[2, 0] * u * u + noise[2, 1])
                    if there:
                        gap, own = gnss[run, t, at, c] - x[run, t, k, c], cov[run, t, k, c, c] if len(cov) > 0 else 0.0
                        r[c], p[c], e[c] = r[c] + gap, p[c] + own, e[c] + gnss[run, t, at, c] - moved[c]
                        q += gap * gap / (noise[0, c] + noise[1, c] + own)
                before, t = t, t + (every if there else 1)
                if not there:
                    continue
                count, far, total = count + 1, far + int(q > BEYOND), total + q
                if count < TOGETHER:
                    continue
                mean, slip = 0.0, 0.0
                for c in range(3):
                    variance = noise[0, c] / TOGETHER + noise[1, c]
                    mean += (r[c] / TOGETHER) ** 2 / (p[c] / TOGETHER + variance)
                    slip += ((e[c] - last[c]) / TOGETHER) ** 2 / (2.0 * variance + walk + old)
                    last[c], r[c], p[c], e[c] = e[c], 0.0, 0.0, 0.0
                mark = FAR if far == TOGETHER else 0
                if far < TOGETHER and len(cov) > 0 and max(mean, 2.0 * total / TOGETHER) > DOUBT:
                    mark = SURE
                if begin >= 0 and slip > DOUBT:
                    mark |= SLIPS
                for i in range(begin if mark >= SLIPS else first, before + 1 if mark > 0 else 0):
                    marks[k, i] |= mark
                begin, count, far, total, walk, old = first, 0, 0, 0.0, 0.0, walk


@compiled
def mark_neighbours(
    gnss: Floats,
    relative: Floats,
    estimates: Floats,
    cov: Floats,
    neighbours: Floats,
    links: Ints,
    fix: Floats,
    lasts: float,
    std: Floats,
    every: int,
    marks: Ints,
) -> None:
    """Mark where TOGETHER messages or relative measurements of a neighbour are all far from estimates.

    Args:
        gnss: (R, T, N, 3) m.
        relative: (R, L, 3) m, rad, rad, NaN for none.
        estimates: (R, T, 3) m of the ego.
        cov: (R, T, 3, 3) m^2.
        neighbours: (R, M, 3) m, estimates by link of the ego.
        links: (M, 3) in time order: index among all L, step and neighbour of each.
        fix: (3,) m^2, variance.
        lasts: m^2, what of it lasts.
        std: (3,) m, rad, rad.
        every: steps from one to the next, at least.
        marks: (2, N, T) out, FAR: messages, relative measurements.
    """
    seen = np.zeros((gnss.shape[2], 5), np.int64)
    for run in range(gnss.shape[0]):
        seen[:, 0], seen[:, 1] = -every, 0
        for i in range(len(links)):
            link, t, j = links[i]
            x, y, z = less(neighbours[run, i], estimates[run, t])
            if t < seen[j, 0] + every or math.isnan(x):
                continue
            if seen[j, 1] == 0:
                seen[j, 2:] = t, 0, 0
            polar, p = direction(x, y, z), cov[run, t]
            measured = with_std(five(relative[run, link, 0], relative[run, link, 1], relative[run, link, 2]), std)
            gap, size, own = (
                residuals(measured, polar),
                metres(polar, measured[5:], 0.0),
                (p[0, 0] + p[1, 1] + p[2, 2]) / 3.0 + lasts,
            )
            q, message = gap[0] * gap[0] / (size[0] * size[0] + own), 0.0
            q += (polar[0] * polar[3] * gap[1]) ** 2 / (size[1] * size[1] + own)
            q += (polar[0] * gap[2]) ** 2 / (size[2] * size[2] + own)
            own += std[0] * std[0] + (polar[0] * std[1]) ** 2
            for c in range(3):
                message += (gnss[run, t, j, c] - neighbours[run, i, c]) ** 2 / (fix[c] + own)
            seen[j, 0], seen[j, 1] = t, seen[j, 1] + 1
            seen[j, 3] += message > BEYOND
            seen[j, 4] += q > BEYOND
            if seen[j, 1] == TOGETHER:
                for kind in range(2):
                    for k in range(seen[j, 2], t + 1 if seen[j, 3 + kind] == TOGETHER else 0):
                        marks[kind, j, k] = FAR
                seen[j, 1] = 0
