"""One ego's filter by covariance intersection, split or plain: `coopoc.methods.covariance_intersection`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...arrays import AnyArray, Floats
from ..compiling.compile import compiled, part
from ..compiling.vectors import LANES
from .fusion import DIAGONAL, NOTHING, PLACE, UNIT, Fusion, best_weight, describe, fuse, inverse3, plus, six, times
from .messages import (
    MOVED,
    NEW,
    NONE,
    POSITION,
    PROCESS,
    VARIANCE,
    Assumptions,
    Measurements,
    Star,
    gather,
    largest,
    position_or_nan,
    star_within,
)
from .relative import converted_cov, vector


@compiled
def follow(seen: Measurements, known: Assumptions, split: bool, least_det: bool) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, and the neighbours' own estimates (R, M, 3) m, NaN for none.

    Args:
        seen: `broadcast` holds every vehicle's own estimate.
        known: `broadcast` its variance m^2.
        least_det: choose w for the least determinant of the fused covariance, instead of its trace.
    """
    runs, steps = seen.gnss.shape[:2]
    out = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.relative.shape[1], 3))
    most = largest(seen.start)
    believed = np.zeros((LANES, 16))
    fusion = Fusion(np.empty((most, 22)), np.zeros((most, 3)), np.zeros(9), np.empty(18), np.empty(3))
    for first in range(0, runs, LANES):
        star, old, last = star_within(most), NONE, min(first + LANES, runs) - 1
        for t in range(steps):
            n = gather(star, seen, known, (first, last), t, old)
            for lane in range(last - first + 1):
                step(star, known, fusion, believed[lane], (split, least_det), (n, old, lane))
                write(out, star, believed[lane], (first + lane, t, seen.start[t]), n, lane)
            old = n
    return out


@part
def write(out: Any, star: Star, believed: AnyArray, at: Any, n: int, lane: int) -> None:
    """Copy what a step found in one run."""
    (x, cov, theirs), (run, t, link) = out, at
    for i in range(3):
        x[run, t, i] = believed[i]
        for j in range(3):
            cov[run, t, i, j] = believed[3 + PLACE[i][j]] + believed[9 + PLACE[i][j]]
        for k in range(1, n):
            theirs[run, link + k - 1, i] = position_or_nan(star, k, i, lane)


@part
def message(star: Star, k: int, row: int, lane: int) -> Any:
    """Three numbers of member k's last message."""
    at = 12 * k + 3 * row
    return star.motion[at, lane], star.motion[at + 1, lane], star.motion[at + 2, lane]


@part
def diagonal(v: Any) -> Any:
    """A diagonal matrix."""
    return v[0], 0.0, 0.0, v[1], 0.0, v[2]


@part
def step(star: Star, known: Assumptions, fusion: Fusion, believed: AnyArray, choice: Any, sizes: Any) -> None:
    """Predict and fuse one run, whose belief is (16,): x m, dependent and independent covariance m^2, w."""
    (split, least_det), (n, old, lane) = choice, sizes
    w, dependent, independent = 0.5, NOTHING, diagonal(message(star, 0, VARIANCE, lane))
    fix, variance, moved = (
        message(star, 0, POSITION, lane),
        message(star, 0, VARIANCE, lane),
        message(star, 0, MOVED, lane),
    )
    fusion.fixed[:] = 0.0
    for c in range(3):
        fusion.at[c] = fix[c] if old == 0 else believed[c] + moved[c]
        if old > 0:
            weight = star.status[NEW, lane] / variance[c]
            fusion.fixed[DIAGONAL[c]], fusion.fixed[6 + c] = weight, weight * (fix[c] - fusion.at[c])
    if old > 0:
        w, dependent = believed[15], six(believed, 3)
        independent = plus(six(believed, 9), diagonal(message(star, 0, PROCESS, lane)))
    alone = describe(dependent, independent, split, fusion.source, 0)
    count = gather_sources(star, known, fusion, split, n, lane)
    w = best_weight(fusion, count, least_det, alone, w)
    dependent, independent = fuse(fusion, count, w)
    for k in range(6):
        believed[3 + k], believed[9 + k] = dependent[k], independent[k]
    believed[0], believed[1], believed[2], believed[15] = fusion.at[0], fusion.at[1], fusion.at[2], w


@part
def gather_sources(star: Star, known: Assumptions, fusion: Fusion, split: bool, n: int, lane: int) -> int:
    """Sources of the neighbours of which a message is held, behind the ego's own, and the gaps m of their pseudo-fixes;
    how many there are.

    A source that depends on nothing joins the fix: its information counts whatever the weight.
    """
    count, at, fixed = 1, fusion.at, fusion.fixed
    for k in range(1, n):
        if math.isnan(position_or_nan(star, k, 0, lane)):
            continue
        x, y, z = message(star, k, POSITION, lane)
        x, y, z = x - at[0], y - at[1], z - at[2]
        seen, relative = direction(x, y, z), UNIT
        if len(known.relative_std):
            relative = converted_cov(seen, deviations(star, k, lane), known.min_range)
        p, q, r = vector(measured(star, seen, k, lane))
        p, q, r = x - p, y - q, z - r
        theirs = diagonal(message(star, k, VARIANCE, lane))
        if describe(theirs, relative, split, fusion.source, count):
            weight = inverse3(plus(theirs, relative))
            u, v, w = times(weight, p, q, r)
            for m, value in enumerate((*weight, u, v, w)):
                fixed[m] += value
        else:
            fusion.gap[count, 0], fusion.gap[count, 1], fusion.gap[count, 2] = p, q, r
            count += 1
    return count


@part
def deviations(star: Star, k: int, lane: int) -> Any:
    """Standard deviations of range m and angles rad."""
    return star.relative[8 * k + 5, lane], star.relative[8 * k + 6, lane], star.relative[8 * k + 7, lane]


@part
def measured(star: Star, expected: Any, k: int, lane: int) -> Any:
    """The measurement of member k, its missing components as expected."""
    at, (d, a, i) = 8 * k, deviations(star, k, lane)
    return (
        star.relative[at, lane] if d < math.inf else expected[0],
        star.relative[at + 1, lane] if a < math.inf else expected[1],
        star.relative[at + 2, lane] if a < math.inf else expected[2],
        star.relative[at + 3, lane] if i < math.inf else expected[3],
        star.relative[at + 4, lane] if i < math.inf else expected[4],
    )


@part
def direction(x: float, y: float, z: float) -> Any:
    """Length of a vector, sine and cosine of its azimuth and of its inclination."""
    flat2 = x * x + y * y
    flat, d = math.sqrt(flat2), math.sqrt(flat2 + z * z)
    sine, cosine = (y / flat, x / flat) if flat > 0.0 else (0.0, 1.0)
    up, level = (flat / d, z / d) if d > 0.0 else (0.0, 1.0)
    return d, sine, cosine, up, level
