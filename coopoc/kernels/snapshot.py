"""The most probable star of each run and step: converted linear start, then exact Gauss-Newton steps.

A neighbour meets only the ego: H_k = G_k + E_k is eliminated, with G its fix and E its edge, and the ego remains,
S = G_0 + sum E_k - E_k H_k^-1 E_k. Its covariance is S^-1. LANES runs go abreast, each with the digits that it has
alone: one that has settled stands still until the others have. The tuples `measured` and `assumed` are those of
`coopoc.kernels.star_messages`, `fresh` being where a message is held.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy import uint64

from ..arrays import AnyArray, Floats, Ints
from .abreast import less, plus, put, take
from .blocks import inverse3
from .blocks_abreast import put_three, three
from .compile import as_written
from .lanes import LANES
from .messages_abreast import tell as tell_abreast
from .sighting import exact, vector

SOLVED, MET, LOST = 0, 1, 2
"""Solved exactly; solved converted, since two vehicles met; not solved: Gauss-Newton did not settle."""
LIMIT = 12
"""Gauss-Newton steps; about 3 are needed."""
HALVES = 200
"""Half steps where whole ones go to and fro, before the damped reference has to do it. They gain a digit every three or
four, so that the last must be the shorter."""
LEAST_RANGE, LEAST_SINE = 1.0, 0.05
"""m; of the converted start, as in `coopoc.optimize.initial`."""
FAR = 1e300
"""m, farther than any neighbour."""


@as_written
def snapshots(measured: Any, assumed: Any, tolerance: float, apart: float) -> tuple[Floats, Floats, Floats, Ints]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN if never heard, how each ended (R, T).

    The covariance is that of the last linearisation, at most `tolerance` away.

    Args:
        tolerance: m, largest move in the last step. apart: m on the ground, closer vehicles stand in one place.
    """
    gnss, _, seen, _, start = measured[:5]
    runs, steps, most = gnss.shape[0], gnss.shape[1], 1 + np.diff(start).max()
    x, cov, others = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    ended, each, held = np.empty((runs, steps), np.int64), most * LANES, np.zeros((5, most, LANES))
    motion, point, sight, edges = np.zeros(12 * each), np.zeros(3 * each), np.zeros(5 * each), np.zeros(15 * each)
    spread, settled, nearest = np.zeros(6 * LANES), np.zeros(LANES), np.zeros(LANES)
    star = (motion, point, sight, edges, spread)
    for first in range(0, runs, LANES):
        last = min(first + LANES, runs) - 1
        for t in range(steps):
            n = 1 + start[t + 1] - start[t]
            hear(measured, assumed, first, last, t, n, held, star)
            here = (first, last, t, start[t])
            solve(star, n, assumed[2], assumed[3], tolerance, apart, settled, nearest, here, (x, cov, others, ended))
    return x, cov, others, ended


@as_written
def hear(measured: Any, assumed: Any, first: int, last: int, t: int, n: int, held: AnyArray, star: Any) -> None:
    """What the members say, and how the neighbours are seen."""
    seen, neighbour, start, newest, ego = measured[2], measured[3], measured[4], measured[5], measured[7]
    motion, _, sight = star[:3]
    for k in range(n):
        link = start[t] + k - 1
        for lane in range(LANES):
            run = min(first + lane, last)
            held[0, k, lane], held[1, k, lane] = t if k == 0 else newest[run, link], 1.0
            for c in range(5 if k > 0 else 0):
                sight[uint64(LANES * (5 * k + c) + lane)] = seen[run, link, c]
        tell_abreast(measured, assumed, (first, last), t, k, ego if k == 0 else neighbour[link], held, motion)


@as_written
def begin(star: Any, n: int) -> None:
    """Everyone stands where their fix is."""
    motion, point = star[:2]
    for k in range(n):
        put_three(point, k, three(motion, 4 * k + 2))


@as_written
def solve(
    star: Any, n: int, std: AnyArray, least: float, tolerance: float, apart: float, settled: AnyArray,
    nearest: AnyArray, here: Any, out: Any,
) -> None:  # fmt: skip
    """Points, the ego's covariance and how it ended, of each run that goes abreast, into `out`.

    Args:
        std: (3,) m, rad, rad, of no length for unit matrices. least: m, angles of a shorter range are widened.
        settled, nearest: (LANES,) scratch.
    """
    begin(star, n)
    convert(star, n, std, least)
    put(settled, uint64(0), step(star, n, 1.0))
    lanes, todo = here[1] - here[0] + 1, 0
    for lane in range(lanes):
        settled[lane] = 1.0 if len(std) == 0 else 0.0
        todo += settled[lane] == 0.0
        if settled[lane] == 1.0:
            tell(star, n, lane, here, SOLVED, out)
    for lane in range(lanes, LANES):
        settled[lane] = 1.0
    for count in range(LIMIT + HALVES):
        if todo == 0:
            break
        relinearise(star, n, std, least)
        share, enough = (1.0, tolerance) if count < LIMIT else (0.5, 1e-3 * tolerance)
        put(nearest, uint64(0), step(star, n, share * (1.0 - take(settled, uint64(0)))))
        for lane in range(lanes):
            if settled[lane] == 0.0 and nearest[lane] <= enough:
                settled[lane], todo = 1.0, todo - 1
                tell(star, n, lane, here, SOLVED, out)
    for lane in range(lanes):
        if settled[lane] == 0.0:
            tell(star, n, lane, here, LOST, out)
    if len(std):
        put(nearest, uint64(0), ground(star, n))
        mend_met(star, n, std, least, apart, settled, nearest, here, out)


@as_written
def mend_met(
    star: Any, n: int, std: AnyArray, least: float, apart: float, settled: AnyArray, nearest: AnyArray, here: Any,
    out: Any,
) -> None:  # fmt: skip
    """Where a neighbour is `apart` or less from the ego, the converted problem answers."""
    met = 0
    for lane in range(here[1] - here[0] + 1):
        met += settled[lane] == 1.0 and nearest[lane] < apart
    if met == 0:
        return
    begin(star, n)
    convert(star, n, std, least)
    step(star, n, 1.0)
    for lane in range(here[1] - here[0] + 1):
        if settled[lane] == 1.0 and nearest[lane] < apart:
            tell(star, n, lane, here, MET, out)


@as_written
def tell(star: Any, n: int, lane: int, here: Any, how: int, out: Any) -> None:
    """What one of the runs has found."""
    motion, point, _, _, spread = star
    x, cov, others, ended = out
    run, t, link = here[0] + lane, here[2], here[3]
    ended[run, t], at = how, 0
    for i in range(3):
        x[run, t, i] = point[i * LANES + lane]
        for j in range(i, 3):
            cov[run, t, i, j] = cov[run, t, j, i] = spread[at * LANES + lane]
            at += 1
    for k in range(1, n):
        for i in range(3):
            heard = motion[uint64((12 * k + 9) * LANES + lane)] > 0.0
            others[run, link + k - 1, i] = point[uint64((3 * k + i) * LANES + lane)] if heard else np.nan


@as_written
def sighted(sight: AnyArray, k: int) -> Any:
    """What is seen of member k, as in `unfolded`."""
    at = uint64(5 * k)
    return (take(sight, at), take(sight, at + uint64(1)), take(sight, at + uint64(2)), take(sight, at + uint64(3)),
            take(sight, at + uint64(4)))  # fmt: skip


@as_written
def widened(seen: Any, std: Any, least: float) -> Any:
    """Standard deviations of a sighting: `coopoc.optimize.sights.relative_std`."""
    wide = max(least / seen[0], 1.0)
    return std[0], -max(-(wide * std[1]), -math.pi), -max(-(wide * std[2]), -math.pi)


@as_written
def as_measured(seen: Any, std: Any, least: float) -> Any:
    """Information, upper triangle, of a converted sighting where it was measured; the unit matrix without `std`."""
    if len(std) == 0:
        o = 0.0 * seen[0]
        return o + 1.0, o, o, o + 1.0, o, o + 1.0
    s0, s1, s2 = widened(seen, std, least)
    sa, ca, si, ci = seen[1], seen[2], seen[3], seen[4]
    d = max(seen[0], LEAST_RANGE)
    b, c = s1 * d * max(abs(si), LEAST_SINE), s2 * d
    o = 0.0 * d
    a, b, c = 1.0 / (o + s0 * s0), 1.0 / (b * b), 1.0 / (c * c)
    flat, cross = plus(a * si * si, c * ci, ci), (a - c) * si * ci
    return (plus(flat * ca * ca, b * sa, sa), (flat - b) * sa * ca, cross * ca, plus(flat * sa * sa, b * ca, ca),
            cross * sa, plus(a * ci * ci, c * si, si))  # fmt: skip


@as_written
def put_edge(edges: AnyArray, k: int, edge: Any) -> None:
    """The first nine of the fifteen numbers of member k."""
    at = uint64(15 * k)
    put(edges, at, edge[0])
    put(edges, at + uint64(1), edge[1])
    put(edges, at + uint64(2), edge[2])
    put(edges, at + uint64(3), edge[3])
    put(edges, at + uint64(4), edge[4])
    put(edges, at + uint64(5), edge[5])
    put(edges, at + uint64(6), edge[6])
    put(edges, at + uint64(7), edge[7])
    put(edges, at + uint64(8), edge[8])


@as_written
def convert(star: Any, n: int, std: AnyArray, least: float) -> None:
    """Edges: information of the converted sightings and what they pull at the points."""
    _, point, sight, edges, _ = star
    u, v, w = three(point, 0)
    for k in range(1, n):
        one = sighted(sight, k)
        xx, xy, xz, yy, yz, zz = as_measured(one, std, least)
        (a, b, c), (p, q, r) = vector(one), three(point, k)
        x, y, z = a - p + u, b - q + v, c - r + w
        put_edge(edges, k, (xx, xy, xz, yy, yz, zz, plus(plus(xx * x, xy, y), xz, z), plus(plus(xy * x, yy, y), yz, z),
                            plus(plus(xz * x, yz, y), zz, z)))  # fmt: skip


@as_written
def relinearise(star: Any, n: int, std: AnyArray, least: float) -> None:
    """Edges linear in range and angles at the points."""
    _, point, sight, edges, _ = star
    u, v, w = three(point, 0)
    for k in range(1, n):
        one, (x, y, z) = sighted(sight, k), three(point, k)
        put_edge(edges, k, exact(x - u, y - v, z - w, one, widened(one, std, least), 0.0))


@as_written
def step(star: Any, n: int, moves: Any) -> Any:
    """One step to the minimum of the linear problem, in place, times `moves`; m, how far the farthest point goes.

    A neighbour of weight zero adds nothing to the ego, and stays where it is.
    """
    motion, point, _, edges, spread = star
    gx, gy, gz = three(motion, 3)
    (u, v, w), (x, y, z) = three(motion, 2), three(point, 0)
    px, py, pz = gx * (u - x), gy * (v - y), gz * (w - z)
    o = 0.0 * gx
    sxx, sxy, sxz, syy, syz, szz = gx, o, o, gy, o, gz
    for k in range(1, n):
        at, (gx, gy, gz) = uint64(15 * k), three(motion, 4 * k + 3)
        (u, v, w), (x, y, z) = three(motion, 4 * k + 2), three(point, k)
        a, b, c, d, f, g = inverse3(
            take(edges, at) + gx, take(edges, at + uint64(1)), take(edges, at + uint64(2)),
            take(edges, at + uint64(3)) + gy, take(edges, at + uint64(4)), take(edges, at + uint64(5)) + gz,
        )  # fmt: skip
        put(edges, at + uint64(9), a)
        put(edges, at + uint64(10), b)
        put(edges, at + uint64(11), c)
        put(edges, at + uint64(12), d)
        put(edges, at + uint64(13), f)
        put(edges, at + uint64(14), g)
        # E - E H^-1 E = G - G H^-1 G, and G is diagonal
        sxx, sxy, sxz = less(sxx + gx, gx * a, gx), less(sxy, gx * b, gy), less(sxz, gx * c, gz)
        syy, syz, szz = less(syy + gy, gy * d, gy), less(syz, gy * f, gz), less(szz + gz, gz * g, gz)
        # -p + E H^-1 (x + p) = x - G H^-1 (x + p)
        x, y, z = gx * (u - x), gy * (v - y), gz * (w - z)
        u, v, w = x + take(edges, at + uint64(6)), y + take(edges, at + uint64(7)), z + take(edges, at + uint64(8))
        u, v, w = (plus(plus(a * u, b, v), c, w), plus(plus(b * u, d, v), f, w), plus(plus(c * u, f, v), g, w))
        put(edges, at + uint64(6), u)
        put(edges, at + uint64(7), v)
        put(edges, at + uint64(8), w)
        px, py, pz = px + less(x, gx, u), py + less(y, gy, v), pz + less(z, gz, w)
    a, b, c, d, f, g = inverse3(sxx, sxy, sxz, syy, syz, szz)
    put_three(spread, 0, (a, b, c))
    put_three(spread, 1, (d, f, g))
    x, y, z = plus(plus(a * px, b, py), c, pz), plus(plus(b * px, d, py), f, pz), plus(plus(c * px, f, py), g, pz)
    most = max(max(abs(x), abs(y)), abs(z))
    for k in range(1, n):
        dx, dy, dz = follows(edges, motion, k, x, y, z)
        most = max(most, max(max(abs(dx), abs(dy)), abs(dz)))
        u, v, w = three(point, k)
        put_three(point, k, (plus(u, dx, moves), plus(v, dy, moves), plus(w, dz, moves)))
    u, v, w = three(point, 0)
    put_three(point, 0, (plus(u, x, moves), plus(v, y, moves), plus(w, z, moves)))
    return most


@as_written
def follows(edges: AnyArray, motion: AnyArray, k: int, x: Any, y: Any, z: Any) -> Any:
    """How far member k goes if the ego goes (x, y, z): H^-1 (x + p) + H^-1 E dx_0, and H^-1 E = I - H^-1 G."""
    at, (gx, gy, gz) = uint64(15 * k), three(motion, 4 * k + 3)
    a, b, c = take(edges, at + uint64(9)), take(edges, at + uint64(10)), take(edges, at + uint64(11))
    d, f, g = take(edges, at + uint64(12)), take(edges, at + uint64(13)), take(edges, at + uint64(14))
    u, v, w = gx * x, gy * y, gz * z
    heard = gx / max(gx, 1e-300)
    return (heard * (take(edges, at + uint64(6)) + x - plus(plus(a * u, b, v), c, w)),
            heard * (take(edges, at + uint64(7)) + y - plus(plus(b * u, d, v), f, w)),
            heard * (take(edges, at + uint64(8)) + z - plus(plus(c * u, f, v), g, w)))  # fmt: skip


@as_written
def ground(star: Any, n: int) -> Any:
    """m on the ground between the ego and the neighbour nearest to it; one without a fix stands where it is seen."""
    motion, point, sight, _, _ = star
    u, v, _ = three(point, 0)
    nearest = 0.0 * u + FAR
    for k in range(1, n):
        x, y, _ = three(point, k)
        gx, _, _ = three(motion, 4 * k + 3)
        heard, one = gx / max(gx, 1e-300), sighted(sight, k)
        x, y = x - u, y - v
        flat = heard * math.sqrt(plus(x * x, y, y)) + (1.0 - heard) * abs(one[0] * one[3])
        nearest = -max(-nearest, -flat)
    return nearest
