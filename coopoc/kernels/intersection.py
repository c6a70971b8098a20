"""One ego's filter by covariance intersection, split or plain, over a whole drive, one run after the other in time.

The filter of `coopoc.methods.covariance_intersection`. The tuple `measured` is that of `coopoc.kernels.star_messages`,
a symmetric (3, 3) six numbers. The information of a source is a quotient of polynomials in its s, which is w for the
ego itself and 1 - w for all others,

    (Cd / s + Ci)^-1 = s adj(Cd + s Ci) / det(Cd + s Ci),

whose coefficients are made once a step. The weight w is not the reference's iterate but its limit: the only minimum of
a convex function, by Newton's method from the weight of the step before, each run until its own has settled.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray, Floats
from .blocks import inverse3
from .compile import compiled, part
from .consensus import times
from .pseudo_fix import DIAGONAL, PLACE, hear, weigh
from .sighting import vector
from .star_messages import three_of

DET = 18
"""Of a source's coefficients, the first of its determinant; before it three times six of its adjugate."""
ROUNDS, TOLERANCE = 60, 1e-8
LEAST, NEGLIGIBLE = 1e-9, 1e-12
"""As in `coopoc.methods.intersection`."""
UNIT = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@compiled
def follow(
    measured: Any, assumed: Any, solo: Any, noise: AnyArray, acceleration: float, split: bool, least_det: bool
) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, and what neighbours say of themselves (R, M, 3) m, NaN for nothing.

    Args:
        assumed: variance of the motion, broadcastable to (R, T, N, 3) m^2; std (3,) m, rad, rad, of no length for unit
            matrices; least range m. solo: (R, T, N, 3) m and m^2. noise: (3,) m^2 of the ego's fix. acceleration:
            m/s^2. least_det: of the fused covariance, instead of its trace.
    """
    gnss, velocity, _, _, start, _, _, ego, dt = measured
    runs, steps = gnss.shape[0], gnss.shape[1]
    x, cov, theirs = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, start[steps], 3))
    most = 1
    for t in range(steps):
        most = max(most, 1 + start[t + 1] - start[t])
    source, gap, at = np.empty((most, 22)), np.zeros((most, 3)), np.empty(3)
    fixed, sums = np.zeros(9), np.empty(18)
    for run in range(runs):
        w, dependent, independent = 0.5, NOTHING, (noise[0], 0.0, 0.0, noise[1], 0.0, noise[2])
        for c in range(3):
            at[c] = gnss[run, 0, ego, c]
        for t in range(steps):
            fixed[:] = 0.0
            for c in range(3 if t > 0 else 0):
                at[c] += dt * velocity[run, t, ego, c]
                fixed[DIAGONAL[c]], fixed[6 + c] = 1.0 / noise[c], (gnss[run, t, ego, c] - at[c]) / noise[c]
            if t > 0:
                a, b, c = three_of(assumed[0], uint64(run), uint64(t), uint64(ego))
                independent = plus(independent, (a, 0.0, 0.0, b, 0.0, c))
            alone = describe(dependent, independent, split, source, 0)
            count = listen(measured, assumed, solo, acceleration, split, run, t, at, source, gap, fixed, theirs)
            w = best_weight(source, count, fixed, sums, least_det, alone, w)
            dependent, independent = fuse(source, count, fixed, sums, w, gap, at)
            for c in range(3):
                x[run, t, c] = at[c]
                for d in range(3):
                    cov[run, t, c, d] = dependent[PLACE[c][d]] + independent[PLACE[c][d]]
    return x, cov, theirs


@part
def describe(d: Any, i: Any, split: bool, source: AnyArray, j: int) -> bool:
    """Coefficients of a source of dependent and independent covariance; True if none of it is dependent."""
    both = plus(d, i)
    alone = split and abs(inner(inverse3(*both), d)) < NEGLIGIBLE
    if alone:
        d, i = NOTHING, both
    elif not split:
        d, i = both, NOTHING
    a, b, c = mixed(d, d), mixed(d, i), mixed(i, i)
    for k in range(6):
        source[j, k], source[j, 6 + k], source[j, 12 + k] = 0.5 * a[k], b[k], 0.5 * c[k]
    source[j, DET] = 0.5 * (d[0] * a[0] + d[1] * a[1] + d[2] * a[2])
    source[j, DET + 1], source[j, DET + 2] = 0.5 * inner(a, i), 0.5 * inner(c, d)
    source[j, DET + 3] = 0.5 * (i[0] * c[0] + i[1] * c[1] + i[2] * c[2])
    return alone


@part
def mixed(a: Any, b: Any) -> Any:
    """adj(a + b) - adj(a) - adj(b): twice the adjugate if they are the same."""
    return (a[3] * b[5] + b[3] * a[5] - 2.0 * a[4] * b[4], a[2] * b[4] + b[2] * a[4] - a[1] * b[5] - b[1] * a[5],
            a[1] * b[4] + b[1] * a[4] - a[2] * b[3] - b[2] * a[3], a[0] * b[5] + b[0] * a[5] - 2.0 * a[2] * b[2],
            a[1] * b[2] + b[1] * a[2] - a[0] * b[4] - b[0] * a[4], a[0] * b[3] + b[0] * a[3] - 2.0 * a[1] * b[1],
            )  # fmt: skip


@part
def inner(a: Any, b: Any) -> Any:
    """tr(a b)."""
    return a[0] * b[0] + a[3] * b[3] + a[5] * b[5] + 2.0 * (a[1] * b[1] + a[2] * b[2] + a[4] * b[4])


@part
def between(a: Any, b: Any) -> Any:
    """a b a."""
    p, q, r = times(b, a[0], a[1], a[2]), times(b, a[1], a[3], a[4]), times(b, a[2], a[4], a[5])
    return (a[0] * p[0] + a[1] * p[1] + a[2] * p[2], a[0] * q[0] + a[1] * q[1] + a[2] * q[2],
            a[0] * r[0] + a[1] * r[1] + a[2] * r[2], a[1] * q[0] + a[3] * q[1] + a[4] * q[2],
            a[1] * r[0] + a[3] * r[1] + a[4] * r[2], a[2] * r[0] + a[4] * r[1] + a[5] * r[2])  # fmt: skip


@part
def listen(
    measured: Any, assumed: Any, solo: Any, acceleration: float, split: bool, run: int, t: int, at: AnyArray,
    source: AnyArray, gap: AnyArray, fixed: AnyArray, theirs: AnyArray,
) -> int:  # fmt: skip
    """Sources of those who are heard, behind the ego's own, and the gaps m of their pseudo-fixes; how many there are.

    Who depends on nothing joins the fix in `fixed`: information (six numbers) and pull (three) whatever the weight.
    """
    _, velocity, seen, neighbour, start, newest, _, _, dt = measured
    variance, std, least = assumed
    count = 1
    for link in range(start[t], start[t + 1]):
        sent, who = newest[run, link], neighbour[link]
        hear(solo[0], velocity, run, t, sent, who, dt, theirs, link)
        if sent < 0:
            continue
        p, q, r = theirs[run, link, 0] - at[0], theirs[run, link, 1] - at[1], theirs[run, link, 2] - at[2]
        u, v, z = vector((seen[run, link, 0], seen[run, link, 1], seen[run, link, 2], seen[run, link, 3],
                          seen[run, link, 4]))  # fmt: skip
        gap[count, 0], gap[count, 1], gap[count, 2] = p - u, q - v, r - z
        late, more = dt * dt * (t - sent) * acceleration, (t - sent) * (t - sent + 2.0)
        i, j, k = uint64(run), uint64(sent), uint64(who)
        (a, b, c), (e, f, g) = three_of(variance, i, j, k), three_of(solo[1], i, j, k)
        said = (e + more * (a + late * late), 0.0, 0.0, f + more * (b + late * late), 0.0, g + more * (c + late * late))
        relative = weigh(direction(p, q, r), std, least)
        if describe(said, relative, split, source, count):
            weight = inverse3(*plus(said, relative))
            p, q, r = times(weight, p - u, q - v, r - z)
            for m, value in enumerate((*weight, p, q, r)):
                fixed[m] += value
        else:
            count += 1
    return count


@part
def direction(x: float, y: float, z: float) -> Any:
    """Length of a vector, sine and cosine of its azimuth and of its inclination."""
    flat2 = x * x + y * y
    flat, d = math.sqrt(flat2), math.sqrt(flat2 + z * z)
    sine, cosine = (y / flat, x / flat) if flat > 0.0 else (0.0, 1.0)
    up, level = (flat / d, z / d) if d > 0.0 else (0.0, 1.0)
    return d, sine, cosine, up, level


@part
def best_weight(
    source: AnyArray, count: int, fixed: AnyArray, sums: AnyArray, least_det: bool, alone: bool, start: float
) -> float:  # fmt: skip
    """w of least trace or determinant in [LEAST, 1]; the ends are looked at when Newton's method asks for them."""
    if count == 1:
        return 1.0
    if alone:
        return LEAST
    low, high, bottom, top = LEAST, 1.0, True, True
    w = start if LEAST < start < 1.0 else 0.5
    for _ in range(ROUNDS):
        first, second = slope(source, count, fixed, sums, w, least_det)
        low, high = w if first <= 0.0 else low, w if first >= 0.0 else high
        newton = w - first / second if second > 0.0 else w
        if newton <= LEAST and bottom:
            bottom = False
            if slope(source, count, fixed, sums, LEAST, least_det)[0] >= 0.0:
                return LEAST
        elif newton >= 1.0 and top:
            top = False
            if slope(source, count, fixed, sums, 1.0, least_det)[0] <= 0.0:
                return 1.0
        before, w = w, newton if low <= newton <= high else 0.5 * (low + high)
        if abs(w - before) < TOLERANCE:
            break
    return w


@part
def slope(source: AnyArray, count: int, fixed: AnyArray, sums: AnyArray, w: float, least_det: bool) -> Any:
    """First and second derivative of tr P or of log det P by w, from those of the information."""
    add_up(source, count, fixed, sums, w)
    p, rise, bend = inverse3(*six(sums, 0)), six(sums, 6), six(sums, 12)
    outer, twice = (p, 1.0) if least_det else (between(p, UNIT), 2.0)
    return -inner(outer, rise), twice * inner(outer, between(rise, p)) - inner(outer, bend)


@part
def six(sums: AnyArray, k: int) -> Any:
    """Six numbers."""
    return sums[k], sums[k + 1], sums[k + 2], sums[k + 3], sums[k + 4], sums[k + 5]


@part
def add_up(source: AnyArray, count: int, fixed: AnyArray, sums: AnyArray, w: float) -> None:
    """Information (six numbers) and its first and second derivative by w (six each) of all sources together."""
    for c in range(6):
        sums[c], sums[6 + c], sums[12 + c] = fixed[c], 0.0, 0.0
    add(source, 0, w, 1.0, sums)
    for j in range(1, count):
        add(source, j, 1.0 - w, -1.0, sums)


@part
def add(source: AnyArray, j: int, s: float, sign: float, sums: AnyArray) -> None:
    """Add what one source says at its s, which is `sign` times w and a constant."""
    p, q, r = source[j, DET + 1], source[j, DET + 2], source[j, DET + 3]
    scale = 1.0 / (source[j, DET] + s * (p + s * (q + s * r)))
    first, second = p + s * (2.0 * q + 3.0 * s * r), 2.0 * q + 6.0 * s * r
    for c in range(6):
        p, q, r = source[j, c], source[j, 6 + c], source[j, 12 + c]
        value = s * (p + s * (q + s * r)) * scale
        rise = (p + s * (2.0 * q + 3.0 * s * r) - value * first) * scale
        sums[c] += value
        sums[6 + c] += sign * rise
        sums[12 + c] += (2.0 * q + 6.0 * s * r - 2.0 * rise * first - value * second) * scale


@part
def fuse(source: AnyArray, count: int, fixed: AnyArray, sums: AnyArray, w: float, gap: AnyArray, at: AnyArray) -> Any:
    """Move the ego to the weighted mean; its dependent and independent covariance.

    The first is P (sum of s dL/ds) P with L the information of a source, since s dL/ds = L (Cd / s) L.
    """
    total, blurred = six(fixed, 0), NOTHING
    x, y, z = fixed[6], fixed[7], fixed[8]
    for j in range(count):
        s = w if j == 0 else 1.0 - w
        sums[:] = 0.0
        add(source, j, s, s, sums)
        p, q, r = times(six(sums, 0), gap[j, 0], gap[j, 1], gap[j, 2])
        x, y, z, total, blurred = x + p, y + q, z + r, plus(total, six(sums, 0)), plus(blurred, six(sums, 6))
    cov = inverse3(*total)
    p, q, r = times(cov, x, y, z)
    at[0], at[1], at[2] = at[0] + p, at[1] + q, at[2] + r
    dependent = between(cov, blurred)
    return dependent, plus(cov, dependent, -1.0)


@part
def plus(a: Any, b: Any, sign: float = 1.0) -> Any:
    """Sum, or difference."""
    return (a[0] + sign * b[0], a[1] + sign * b[1], a[2] + sign * b[2], a[3] + sign * b[3], a[4] + sign * b[4],
            a[5] + sign * b[5])  # fmt: skip
