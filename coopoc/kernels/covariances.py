"""NEES of a track, e^T P^-1 e by P = L D L^T, covariances that are none, and what contradicts a track, in one pass
each."""

from __future__ import annotations

import math

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, part
from .gate import FIX_GATE, REJECTED
from .geometry import direction, five, metres, residuals, with_std

LIMIT = 1.0 + 1e-9
"""A squared covariance over the product of its variances, at most, with what rounding adds."""
TOGETHER, DOUBT = 5, 36.0
"""Numbers that are judged together: they are far where all are beyond FIX_GATE, those of neighbours beyond REJECTED of
it; and the square of their normalised mean, of three degrees of freedom, that chance does not reach."""
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


@part
def travel(velocity: Floats, first: int, stop: int, moved: Floats) -> float:
    """Add the velocities (T, 3) of some steps; the sum of their squares."""
    x, y, z, square = 0.0, 0.0, 0.0, 0.0
    for t in range(first, stop):
        u, v, w = velocity[t, 0], velocity[t, 1], velocity[t, 2]
        x, y, z, square = x + u, y + v, z + w, square + u * u + v * v + w * w
    moved[0], moved[1], moved[2] = moved[0] + x, moved[1] + y, moved[2] + z
    return square


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
    thorough: bool,
    marks: Ints,
) -> None:
    """Mark where TOGETHER fixes, one after the other, contradict estimates (R, T, E, 3) m or the odometer.

    Args:
        gnss: (R, T, N, 3) m, NaN for no fix.
        velocity: (R, T, N, 3) m/s in the same frame, or of no length.
        x: estimates.
        cov: (R, T, E, 3, 3) m^2, or of no length.
        columns: (E,) of the vehicles.
        noise: (3, 3) variances of a fix m^2, what is white and what lasts; of a step's motion, relative, what of that
            lasts, and least m^2.
        every: steps from one fix to the next, at least.
        dt: s.
        thorough: False looks at the odometer of those alone whose estimates are doubtful.
        marks: (E, T) out, sums of FAR, SURE and SLIPS.
    """
    moved, r, p, e, last = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for run in range(gnss.shape[0]):
        for k in range(len(columns)):
            stage, worst = int(thorough), 0.0
            while stage < 2:
                at, count, far, total, first, begin, square, old = columns[k], 0, 0, 0.0, 0, -1, 0.0, 0.0
                moved[:], r[:], p[:], e[:], t, before = 0.0, 0.0, 0.0, 0.0, 0, 0
                while t < gnss.shape[1]:
                    now, t = t, t + 1
                    if math.isnan(gnss[run, now, at, 0]):
                        continue
                    if stage == 1 and len(velocity) > 0:
                        square += dt * dt * travel(velocity[run, :, at], before + 1, t, moved)
                    q, first, before, t = 0.0, now if count == 0 else first, now, now + every
                    for c in range(3):
                        z, own = gnss[run, now, at, c], cov[run, now, k, c, c] if len(cov) > 0 else 0.0
                        gap = z - x[run, now, k, c]
                        r[c], p[c], e[c] = r[c] + gap, p[c] + own, e[c] + z - dt * moved[c]
                        q += gap * gap / (noise[0, c] + noise[1, c] + own)
                    count, far, total = count + 1, far + int(q > FIX_GATE), total + q
                    if count < TOGETHER:
                        continue
                    mean, slip, steps = 0.0, 0.0, now - begin
                    walk = (noise[2, 0] + steps * noise[2, 1]) * (square + old) + steps * noise[2, 2]
                    for c in range(3):
                        variance = noise[0, c] / TOGETHER + noise[1, c]
                        mean += (r[c] / TOGETHER) ** 2 / (p[c] / TOGETHER + variance)
                        slip += ((e[c] - last[c]) / TOGETHER) ** 2 / (2.0 * variance + walk)
                        last[c], r[c], p[c], e[c] = e[c], 0.0, 0.0, 0.0
                    mean = max(mean, 2.0 * total / TOGETHER)
                    mark = FAR if far == TOGETHER else SURE if len(cov) > 0 and mean > DOUBT else 0
                    stop = min(t, gnss.shape[1]) if stage == 1 else 0
                    for i in range(first, stop if mark > 0 else 0):
                        marks[k, i] |= mark
                    for i in range(max(begin, 0), stop if begin >= 0 and slip > DOUBT and len(velocity) > 0 else 0):
                        marks[k, i] |= SLIPS
                    worst, begin, count, far, total, square, old = max(worst, mean), first, 0, 0, 0.0, 0.0, square
                stage += 1 if worst > DOUBT / 3 else 2


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
            seen[j, 3] += message > REJECTED * FIX_GATE
            seen[j, 4] += q > REJECTED * FIX_GATE
            if seen[j, 1] == TOGETHER:
                for kind in range(2):
                    for k in range(
                        seen[j, 2], min(t + every, len(estimates[run])) if seen[j, 3 + kind] == TOGETHER else 0
                    ):
                        marks[kind, j, k] = FAR
                seen[j, 1] = 0
