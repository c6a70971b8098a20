"""One step of a star's snapshot for LANES runs abreast: converted or exact edges, and the minimum of what is linear.

A neighbour meets only the ego: H_k = G_k + E_k is eliminated, with G its fix and E its edge, and the ego remains,
S = G_0 + sum E_k - E_k H_k^-1 E_k. Its covariance is S^-1. A star is a tuple of flat arrays of vectors: of each member
what it says in `motion` (`messages_abreast`), its point m, how it is seen, its edge (information, upper triangle, and
pull) and H_k^-1; then the ego's covariance.
"""

from __future__ import annotations

import math
from typing import Any

from numpy import uint64

from ..arrays import AnyArray
from .abreast import less, plus, take
from .blocks import inverse3
from .blocks_abreast import nine, put_nine, put_three, three
from .compile import as_written
from .sighting import exact, vector

LEAST_RANGE, LEAST_SINE = 1.0, 0.05
"""m; of the converted start, as in `coopoc.optimize.initial`."""
FAR = 1e300
"""m, farther than any neighbour."""


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
def convert(star: Any, n: int, std: AnyArray, least: float) -> None:
    """Edges: information of the converted sightings and what they pull at the points."""
    _, point, sight, edge, _, _ = star
    u, v, w = three(point, 0)
    for k in range(1, n):
        one = sighted(sight, k)
        xx, xy, xz, yy, yz, zz = as_measured(one, std, least)
        (a, b, c), (p, q, r) = vector(one), three(point, k)
        x, y, z = a - p + u, b - q + v, c - r + w
        put_nine(edge, k, (xx, xy, xz, yy, yz, zz, plus(plus(xx * x, xy, y), xz, z), plus(plus(xy * x, yy, y), yz, z),
                            plus(plus(xz * x, yz, y), zz, z)))  # fmt: skip


@as_written
def relinearise(star: Any, n: int, std: AnyArray, least: float) -> None:
    """Edges linear in range and angles at the points."""
    _, point, sight, edge, _, _ = star
    u, v, w = three(point, 0)
    for k in range(1, n):
        one, (x, y, z) = sighted(sight, k), three(point, k)
        put_nine(edge, k, exact(x - u, y - v, z - w, one, widened(one, std, least), 0.0))


@as_written
def step(star: Any, n: int, moves: Any) -> Any:
    """One step to the minimum of the linear problem, in place, times `moves`; m, how far the farthest point goes.

    A neighbour of weight zero adds nothing to the ego, and stays where it is.
    """
    motion, point, _, edge, inverse, spread = star
    gx, gy, gz = three(motion, 3)
    (u, v, w), (x, y, z) = three(motion, 2), three(point, 0)
    px, py, pz = gx * (u - x), gy * (v - y), gz * (w - z)
    o = 0.0 * gx
    sxx, sxy, sxz, syy, syz, szz = gx, o, o, gy, o, gz
    for k in range(1, n):
        (gx, gy, gz), (u, v, w), (x, y, z) = three(motion, 4 * k + 3), three(motion, 4 * k + 2), three(point, k)
        xx, xy, xz, yy, yz, zz, p, q, r = nine(edge, k)
        a, b, c, d, f, g = inverse3(xx + gx, xy, xz, yy + gy, yz, zz + gz)
        put_three(inverse, 2 * k, (a, b, c))
        put_three(inverse, 2 * k + 1, (d, f, g))
        # E - E H^-1 E = G - G H^-1 G, and G is diagonal
        sxx, sxy, sxz = less(sxx + gx, gx * a, gx), less(sxy, gx * b, gy), less(sxz, gx * c, gz)
        syy, syz, szz = less(syy + gy, gy * d, gy), less(syz, gy * f, gz), less(szz + gz, gz * g, gz)
        # -p + E H^-1 (x + p) = x - G H^-1 (x + p)
        x, y, z = gx * (u - x), gy * (v - y), gz * (w - z)
        u, v, w = x + p, y + q, z + r
        u, v, w = (plus(plus(a * u, b, v), c, w), plus(plus(b * u, d, v), f, w), plus(plus(c * u, f, v), g, w))
        put_three(edge, 3 * k + 2, (u, v, w))
        px, py, pz = px + less(x, gx, u), py + less(y, gy, v), pz + less(z, gz, w)
    a, b, c, d, f, g = inverse3(sxx, sxy, sxz, syy, syz, szz)
    put_three(spread, 0, (a, b, c))
    put_three(spread, 1, (d, f, g))
    x, y, z = plus(plus(a * px, b, py), c, pz), plus(plus(b * px, d, py), f, pz), plus(plus(c * px, f, py), g, pz)
    most = max(max(abs(x), abs(y)), abs(z))
    for k in range(1, n):
        dx, dy, dz = follows(edge, inverse, motion, k, x, y, z)
        most = max(most, max(max(abs(dx), abs(dy)), abs(dz)))
        u, v, w = three(point, k)
        put_three(point, k, (plus(u, dx, moves), plus(v, dy, moves), plus(w, dz, moves)))
    u, v, w = three(point, 0)
    put_three(point, 0, (plus(u, x, moves), plus(v, y, moves), plus(w, z, moves)))
    return most


@as_written
def follows(edge: AnyArray, inverse: AnyArray, motion: AnyArray, k: int, x: Any, y: Any, z: Any) -> Any:
    """How far member k goes if the ego goes (x, y, z): H^-1 (x + p) + H^-1 E dx_0, and H^-1 E = I - H^-1 G."""
    (gx, gy, gz), (p, q, r) = three(motion, 4 * k + 3), three(edge, 3 * k + 2)
    (a, b, c), (d, f, g) = three(inverse, 2 * k), three(inverse, 2 * k + 1)
    u, v, w = gx * x, gy * y, gz * z
    heard = gx / max(gx, 1e-300)
    return (heard * (p + x - plus(plus(a * u, b, v), c, w)), heard * (q + y - plus(plus(b * u, d, v), f, w)),
            heard * (r + z - plus(plus(c * u, f, v), g, w)))  # fmt: skip


@as_written
def ground(star: Any, n: int) -> Any:
    """m on the ground between the ego and the neighbour nearest to it; one without a fix stands where it is seen."""
    motion, point, sight, _, _, _ = star
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
