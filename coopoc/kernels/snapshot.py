"""The most probable star of each run and step: converted linear start, then exact Gauss-Newton steps.

A neighbour meets only the ego: H_k = G_k + E_k is eliminated, with G its fix and E its edge, and the ego remains,
S = G_0 + sum E_k - E_k H_k^-1 E_k. Its covariance is S^-1. The tuples `measured` and `assumed` are those of
`coopoc.kernels.star_messages`, `fresh` being where a message is held.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats, Ints
from .blocks import inverse3
from .compile import compiled
from .sighting import exact, vector
from .star_messages import hear

SOLVED, MET, LOST = 0, 1, 2
"""Solved exactly; solved converted, since two vehicles met; not solved: Gauss-Newton did not settle."""
LIMIT = 12
"""Gauss-Newton steps before the damped reference has to do it; about 3 are needed."""
LEAST_RANGE, LEAST_SINE = 1.0, 0.05
"""m; of the converted start, as in `coopoc.optimize.initial`."""


@compiled
def snapshots(measured: Any, assumed: Any, tolerance: float, apart: float) -> tuple[Floats, Floats, Floats, Ints]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, neighbours (R, M, 3) m, NaN if never heard, how each ended (R, T).

    Args:
        tolerance: m, largest move in the last step. apart: m on the ground, closer vehicles stand in one place.
    """
    gnss, _, seen, _, start = measured[:5]
    runs, steps = gnss.shape[0], gnss.shape[1]
    x, cov, others = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    ended = np.empty((runs, steps), np.int64)
    most = 1 + np.diff(start).max()
    motion, who, nobody = np.zeros((4, most, 3)), np.zeros((4, most), np.int64), np.zeros((3, 0), np.int64)
    edges, point = np.zeros((most, 15)), np.zeros((most, 3))
    for run in range(runs):
        for t in range(steps):
            n = 1 + start[t + 1] - start[t]
            hear(measured, assumed, run, t, who[:, :n], nobody, motion)
            here = seen[run, start[t] : start[t + 1]]
            ended[run, t] = solve_star(motion[2, :n], motion[3, :n], here, assumed[2], assumed[3], tolerance, apart,
                                       edges, point, cov[run, t])  # fmt: skip
            x[run, t] = point[0]
            others[run, start[t] : start[t + 1]] = point[1:n]
    return x, cov, others, ended


@compiled
def solve_star(
    fix: AnyArray, weight: AnyArray, seen: AnyArray, std: AnyArray, least: float, tolerance: float, apart: float,
    edges: AnyArray, point: AnyArray, cov: AnyArray,
) -> int:  # fmt: skip
    """One star in place: points (n, 3) m, the ego first, its covariance (3, 3) m^2, and how it ended.

    The covariance is that of the last linearisation, at most `tolerance` away.

    Args:
        fix, weight: (n, 3) m, 1/m^2, zero of a neighbour that has none: it is left out. seen: (n - 1, 5) of `unfolded`.
        std: (3,) m, rad, rad, of no length for unit matrices. least: m, angles of a shorter range are widened.
        edges: (n, 15) scratch.
    """
    n = len(fix)
    point[:n] = fix
    convert(weight, seen, std, least, edges, point)
    move(fix, weight, edges, point, cov)
    ended = SOLVED
    if len(std):
        ended = LOST
        for _ in range(LIMIT):
            relinearise(weight, seen, std, least, edges, point)
            if move(fix, weight, edges, point, cov) <= tolerance:
                ended = SOLVED
                break
        if ended == SOLVED and meeting(weight, seen, point, apart):
            convert(weight, seen, std, least, edges, point)
            move(fix, weight, edges, point, cov)
            ended = MET
    for k in range(1, n):
        if weight[k, 0] == 0.0:
            point[k] = np.nan
    return ended


@compiled
def widened(seen: AnyArray, std: AnyArray, least: float) -> Any:
    """Standard deviations of a sighting: `coopoc.optimize.sights.relative_std`."""
    if seen[0] >= least:
        return std[0], std[1], std[2]
    wide = least / seen[0]
    return std[0], min(wide * std[1], math.pi), min(wide * std[2], math.pi)


@compiled
def convert(weight: AnyArray, seen: AnyArray, std: AnyArray, least: float, edges: AnyArray, point: AnyArray) -> None:
    """Edges (n, 9): information of the converted sightings and what they pull at `point`."""
    for k in range(1, len(weight)):
        if weight[k, 0] == 0.0:
            continue
        one = seen[k - 1]
        xx, xy, xz, yy, yz, zz = as_measured(one, std, least)
        x, y, z = vector(one)
        x, y, z = x - point[k, 0] + point[0, 0], y - point[k, 1] + point[0, 1], z - point[k, 2] + point[0, 2]
        e = edges[k]
        e[0], e[1], e[2], e[3], e[4], e[5] = xx, xy, xz, yy, yz, zz
        e[6], e[7], e[8] = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


@compiled
def as_measured(seen: Any, std: Any, least: float) -> Any:
    """Information, upper triangle, of a converted sighting where it was measured; the unit matrix without `std`."""
    if len(std) == 0:
        return 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
    s0, s1, s2 = widened(seen, std, least)
    sa, ca, si, ci = seen[1], seen[2], seen[3], seen[4]
    d = max(seen[0], LEAST_RANGE)
    a, b, c = 1.0 / s0**2, 1.0 / (s1 * d * max(abs(si), LEAST_SINE)) ** 2, 1.0 / (s2 * d) ** 2
    flat, cross = a * si * si + c * ci * ci, (a - c) * si * ci
    return (flat * ca * ca + b * sa * sa, (flat - b) * sa * ca, cross * ca, flat * sa * sa + b * ca * ca, cross * sa,
            a * ci * ci + c * si * si)  # fmt: skip


@compiled
def relinearise(
    weight: AnyArray, seen: AnyArray, std: AnyArray, least: float, edges: AnyArray, point: AnyArray
) -> None:  # fmt: skip
    """Edges (n, 9) linear in range and angles at `point`."""
    for k in range(1, len(weight)):
        if weight[k, 0] == 0.0:
            continue
        one, e = seen[k - 1], edges[k]
        x, y, z = point[k, 0] - point[0, 0], point[k, 1] - point[0, 1], point[k, 2] - point[0, 2]
        e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], e[8] = exact(x, y, z, one, widened(one, std, least), 0.0)


@compiled
def eliminate(weight: AnyArray, edges: AnyArray, cov: AnyArray) -> None:
    """H_k^-1 into the last six of the edges (n, 15), and the ego's covariance."""
    sxx, sxy, sxz, syy, syz, szz = weight[0, 0], 0.0, 0.0, weight[0, 1], 0.0, weight[0, 2]
    for k in range(1, len(weight)):
        if weight[k, 0] == 0.0:
            continue
        e = edges[k]
        xx, xy, xz, yy, yz, zz = e[0], e[1], e[2], e[3], e[4], e[5]
        gx, gy, gz = weight[k, 0], weight[k, 1], weight[k, 2]
        a, b, c, d, f, g = inverse3(xx + gx, xy, xz, yy + gy, yz, zz + gz)
        e[9], e[10], e[11], e[12], e[13], e[14] = a, b, c, d, f, g
        # E - E H^-1 E = G - G H^-1 G, and G is diagonal
        sxx += gx - gx * a * gx
        sxy -= gx * b * gy
        sxz -= gx * c * gz
        syy += gy - gy * d * gy
        syz -= gy * f * gz
        szz += gz - gz * g * gz
    a, b, c, d, f, g = inverse3(sxx, sxy, sxz, syy, syz, szz)
    cov[0, 0], cov[0, 1], cov[0, 2], cov[1, 0], cov[1, 1], cov[1, 2] = a, b, c, b, d, f
    cov[2, 0], cov[2, 1], cov[2, 2] = c, f, g


@compiled
def move(fix: AnyArray, weight: AnyArray, edges: AnyArray, point: AnyArray, cov: AnyArray) -> float:
    """One step to the minimum of the linear problem, in place; m, how far the point that moves most does."""
    eliminate(weight, edges, cov)
    px, py, pz = (
        weight[0, 0] * (fix[0, 0] - point[0, 0]), weight[0, 1] * (fix[0, 1] - point[0, 1]),
        weight[0, 2] * (fix[0, 2] - point[0, 2]),
    )  # fmt: skip
    for k in range(1, len(weight)):
        if weight[k, 0] == 0.0:
            continue
        e = edges[k]
        a, b, c, d, f, g = e[9], e[10], e[11], e[12], e[13], e[14]
        gx, gy, gz = weight[k, 0], weight[k, 1], weight[k, 2]
        x, y, z = gx * (fix[k, 0] - point[k, 0]), gy * (fix[k, 1] - point[k, 1]), gz * (fix[k, 2] - point[k, 2])
        # -p + E H^-1 (x + p) = x - G H^-1 (x + p)
        ux, uy, uz = x + e[6], y + e[7], z + e[8]
        e[6], e[7], e[8] = a * ux + b * uy + c * uz, b * ux + d * uy + f * uz, c * ux + f * uy + g * uz
        px += x - gx * e[6]
        py += y - gy * e[7]
        pz += z - gz * e[8]
    x, y, z = (
        cov[0, 0] * px + cov[0, 1] * py + cov[0, 2] * pz, cov[1, 0] * px + cov[1, 1] * py + cov[1, 2] * pz,
        cov[2, 0] * px + cov[2, 1] * py + cov[2, 2] * pz,
    )  # fmt: skip
    most: float = max(abs(x), abs(y), abs(z))
    for k in range(1, len(weight)):
        if weight[k, 0] == 0.0:
            continue
        e = edges[k]
        a, b, c, d, f, g = e[9], e[10], e[11], e[12], e[13], e[14]
        # dx_k = H^-1 (x + p) + H^-1 E dx_0, and H^-1 E = I - H^-1 G
        vx, vy, vz = weight[k, 0] * x, weight[k, 1] * y, weight[k, 2] * z
        dx = e[6] + x - (a * vx + b * vy + c * vz)
        dy = e[7] + y - (b * vx + d * vy + f * vz)
        dz = e[8] + z - (c * vx + f * vy + g * vz)
        point[k, 0] += dx
        point[k, 1] += dy
        point[k, 2] += dz
        most = max(most, abs(dx), abs(dy), abs(dz))
    point[0, 0] += x
    point[0, 1] += y
    point[0, 2] += z
    return most


@compiled
def meeting(weight: AnyArray, seen: AnyArray, point: AnyArray, apart: float) -> bool:
    """True if the ego and a neighbour stand in one place; one without a fix stands where it is seen."""
    for k in range(1, len(weight)):
        x, y = point[k, 0] - point[0, 0], point[k, 1] - point[0, 1]
        flat = abs(seen[k - 1, 0] * seen[k - 1, 3]) if weight[k, 0] == 0.0 else math.sqrt(x * x + y * y)
        if flat < apart:
            return True
    return False
