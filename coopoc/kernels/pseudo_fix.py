"""One ego's filter with a pseudo-fix from each neighbour, over a whole drive, one run after the other in time.

The filter of `coopoc.methods.msmv`. The tuple `measured` is that of `coopoc.kernels.star_messages`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import AnyArray, Floats
from .blocks import inverse3
from .compile import compiled


@compiled
def follow(measured: Any, assumed: Any, solo: Any, noise: AnyArray, flat: float) -> tuple[Floats, Floats, Floats]:
    """x (R, T, 3) m, covariance (R, T, 3, 3) m^2, and what neighbours say of themselves (R, M, 3) m, NaN for nothing.

    Args:
        assumed: variance of the motion, broadcastable to (R, T, N, 3) m^2; std (3,) m, rad, rad, of no length for unit
            matrices; least range m.
        solo: (R, T, N, 3) m and m^2, every vehicle's own estimate. noise: (3,) m^2 of the ego's fix. flat: m^2, of the
            ego before it.
    """
    gnss, velocity, seen, neighbour, start, newest, fresh, ego, dt = measured
    variance, std, least = assumed
    runs, steps = gnss.shape[0], gnss.shape[1]
    x, cov, theirs = np.empty((runs, steps, 3)), np.empty((runs, steps, 3, 3)), np.empty((runs, seen.shape[1], 3))
    at, pull, weight, p = np.zeros(3), np.zeros(3), np.zeros(6), np.zeros(6)
    for run in range(runs):
        p[:] = 0.0
        for c in range(3):
            at[c], p[DIAGONAL[c]] = gnss[run, 0, ego, c], flat
        for t in range(steps):
            for c in range(3):
                if t > 0:
                    at[c] += dt * velocity[run, t, ego, c]
                    p[DIAGONAL[c]] += one_of(variance, run, t, ego, c)
            invert(p, weight)
            for c in range(3):
                pull[c] = (gnss[run, t, ego, c] - at[c]) / noise[c]
                weight[DIAGONAL[c]] += 1.0 / noise[c]
            for link in range(start[t], start[t + 1]):
                sent = newest[run, link]
                hear(solo[0], velocity, run, t, sent, neighbour[link], dt, theirs, link)
                if fresh[run, link]:
                    one = (seen[run, link, 0], seen[run, link, 1], seen[run, link, 2], seen[run, link, 3],
                           seen[run, link, 4])  # fmt: skip
                    p[0], p[1], p[2], p[3], p[4], p[5] = weigh(one, std, least)
                    if len(std):
                        for c in range(3):
                            more = one_of(variance, run, sent, neighbour[link], c) * (t - sent) if t > sent else 0.0
                            p[DIAGONAL[c]] += solo[1][run, sent, neighbour[link], c] + more
                        invert(p, p)
                    _add(theirs, seen, run, link, at, p, weight, pull)
            invert(weight, p)
            at[0] += p[0] * pull[0] + p[1] * pull[1] + p[2] * pull[2]
            at[1] += p[1] * pull[0] + p[3] * pull[1] + p[4] * pull[2]
            at[2] += p[2] * pull[0] + p[4] * pull[1] + p[5] * pull[2]
            for c in range(3):
                x[run, t, c] = at[c]
                for d in range(3):
                    cov[run, t, c, d] = p[PLACE[c][d]]
    return x, cov, theirs


DIAGONAL = (0, 3, 5)
PLACE = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Of the numbers of a symmetric (3, 3) in its upper triangle, row by row."""


@compiled
def one_of(values: AnyArray, run: int, t: int, member: int, axis: int) -> Any:
    """Of what is broadcastable to (R, T, N, 3)."""
    i, j, k = min(run, values.shape[0] - 1), min(t, values.shape[1] - 1), min(member, values.shape[2] - 1)
    return values[i, j, k, axis]


@compiled
def invert(a: AnyArray, out: AnyArray) -> None:
    """The inverse of a symmetric (3, 3), both as six numbers."""
    out[0], out[1], out[2], out[3], out[4], out[5] = inverse3(a[0], a[1], a[2], a[3], a[4], a[5])


@compiled
def hear(
    solo: AnyArray, velocity: AnyArray, run: int, t: int, sent: int, who: int, dt: float, theirs: AnyArray, link: int
) -> None:  # fmt: skip
    """What a neighbour says of itself, brought forward."""
    for c in range(3):
        if sent < 0:
            theirs[run, link, c] = np.nan
        elif sent == t:
            theirs[run, link, c] = solo[run, sent, who, c]
        else:
            theirs[run, link, c] = solo[run, sent, who, c] + (t - sent) * dt * velocity[run, sent, who, c]


@compiled
def weigh(one: Any, std: AnyArray, least: float) -> Any:
    """Covariance of a converted vector, `coopoc.world.spherical.vector_cov`, as six numbers; 1 without `std`.

    Args:
        one: range m, sine and cosine of azimuth and of inclination.
    """
    if len(std) == 0:
        return 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
    d, sa, ca, si, ci = one
    d = max(d, least)
    a, b, c = std[0] ** 2, (std[1] * d * si) ** 2, (std[2] * d) ** 2
    flat, cross = a * si * si + c * ci * ci, (a - c) * si * ci
    return (flat * ca * ca + b * sa * sa, (flat - b) * sa * ca, cross * ca, flat * sa * sa + b * ca * ca, cross * sa,
            a * ci * ci + c * si * si)  # fmt: skip


@compiled
def _add(
    theirs: AnyArray, seen: AnyArray, run: int, link: int, at: AnyArray, p: AnyArray, weight: AnyArray, pull: AnyArray
) -> None:  # fmt: skip
    """Add the information `p` of a pseudo-fix, and what it pulls."""
    ground = seen[run, link, 0] * seen[run, link, 3]
    x = theirs[run, link, 0] - ground * seen[run, link, 2] - at[0]
    y = theirs[run, link, 1] - ground * seen[run, link, 1] - at[1]
    z = theirs[run, link, 2] - seen[run, link, 0] * seen[run, link, 4] - at[2]
    for k in range(6):
        weight[k] += p[k]
    pull[0] += p[0] * x + p[1] * y + p[2] * z
    pull[1] += p[1] * x + p[3] * y + p[4] * z
    pull[2] += p[2] * x + p[4] * y + p[5] * z
