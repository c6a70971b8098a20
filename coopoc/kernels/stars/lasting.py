"""Errors that last and may not be there: heading and scale of an odometry, compass, range.

Each is a state with a wide prior N(0, W), and the estimate is the average over whether it is there. Of a scalar error b
with the posterior N(m, p) the odds of b = 0 are, by Bayes' rule, those of the prior times
sqrt(W / p) exp(-m^2 / 2 p), and what is conditional on b = 0 is the filter without that state. So one filter stands for
all hypotheses, as long as an error stays what it is.

References:
    Friedland, Treatment of bias in recursive filtering, IEEE TAC 14(4), 1969; Mitchell, Beauchamp, Bayesian variable
    selection in linear regression, JASA 83, 1988 (spike and slab).
"""

from __future__ import annotations

import math

from ...arrays import Floats
from ..compiling.compile import part
from .cooperative_state import KINDS_OF_NUMBERS, Filter, Model
from .gaussian import COMPASS, PLACE, TURN, Gaussian, has, shift

HEADING, SCALE, OF_COMPASS, OF_RANGE, SLIPS, LEVELS = range(6)
"""Places in `Filter.told`: the ego's errors, rad, 1, rad, m, whether it slips, and the factors of standard
deviations."""


@part
def turned(g: Gaussian, k: int, moved: tuple[float, float, float], w: Floats) -> tuple[float, float, float]:
    """(1 + s) R(b) m, and its derivatives by b and s in w (9,); m itself where odometry does not err."""
    for i in range(9):
        w[i] = 0.0
    if not has(g, k, TURN):
        return moved
    i = 3 * g.block[k, TURN]
    c, s, scale = math.cos(g.x[i]), math.sin(g.x[i]), 1.0 + g.x[i + 1]
    east, north = c * moved[0] - s * moved[1], s * moved[0] + c * moved[1]
    w[0], w[3], w[1], w[4] = -scale * north, scale * east, east, north
    return scale * east, scale * north, moved[2]


@part
def drive(f: Filter, model: Model, k: int, moved: tuple[float, float, float], dt: float) -> None:
    """Move a member by its odometry, whose errors decay."""
    g, w = f.g, f.h.turn
    first, way = 3 * g.block[k, PLACE], turned(g, k, moved, w)
    for c in range(3):
        g.x[first + c] += way[c]
    if not has(g, k, TURN):
        return
    i, n, keep = 3 * g.block[k, TURN], 3 * g.vectors[0], math.exp(-dt / model.lasts)
    for c in range(2):
        for j in range(n):
            g.p[first + c, j] += w[3 * c] * g.p[i, j] + w[3 * c + 1] * g.p[i + 1, j]
    for j in range(n):
        for c in range(2):
            g.p[j, first + c] += w[3 * c] * g.p[j, i] + w[3 * c + 1] * g.p[j, i + 1]
    shift(g, i, i, keep - 1.0)
    for c in range(2):
        g.p[i + c, i + c] += (1.0 - keep * keep) * model.turn[c]


@part
def hold(f: Filter, share: float) -> None:
    """After `correct` with that share of a fix: errors of odometry learn the share of what it says of them.

    P' = P - K S K^T + (1 - share)^2 K_o S K_o^T in the block of these errors o.
    """
    g, h, wide = f.g, f.h, len(f.g.x)
    if share >= 1.0:
        return
    for a in range(len(f.vehicle)):
        if f.vehicle[a] < 0 or not has(g, a, TURN):
            continue
        for i in range(3 * g.block[a, TURN], 3 * g.block[a, TURN] + 2):
            for c in range(3):
                g.x[i] -= (1.0 - share) * share * h.gain[c * wide + i] * h.white[c]
            for b in range(len(f.vehicle)):
                if f.vehicle[b] < 0 or not has(g, b, TURN):
                    continue
                for j in range(3 * g.block[b, TURN], 3 * g.block[b, TURN] + 2):
                    for c in range(3):
                        g.p[i, j] += (1.0 - share) ** 2 * share * h.gain[c * wide + i] * h.gain[c * wide + j]


@part
def average(f: Filter, model: Model) -> None:
    """Write the ego's position and covariance, averaged over which errors are there, to `answer`, and these to `told`.

    `few` has a row for each number of the position and each error, and a column for each error: their covariances.
    """
    g, few, which, x = f.g, f.few, f.which, f.answer
    first, n, width = 3 * g.block[0, PLACE], 3, len(f.few[0]) - 1
    for c in range(3):
        which[c], x[c] = first + c, g.x[first + c]
        for d in range(3):
            x[3 + 3 * c + d] = g.p[first + c, first + d]
    for k in range(len(f.vehicle) - 1, -1, -1):
        if f.vehicle[k] >= 0 and has(g, k, TURN):
            which[n], which[n + 1] = 3 * g.block[k, TURN], 3 * g.block[k, TURN] + 1
            n += 2
    own = n
    if has(g, 0, COMPASS):
        which[n], which[n + 1] = 3 * g.block[0, COMPASS], 3 * g.block[0, COMPASS] + 2
        n += 2
    for i in range(n):
        few[i, width] = g.x[which[i]]
        for j in range(3, n):
            few[i, j - 3] = g.p[which[i], which[j]]
    for i in range(3, n):
        kind = (2 + i - own) if i >= own else (i - 3) % 2
        prior = model.turn[kind] if kind < 2 else model.bias if kind == 2 else model.offset
        collapse(f, i, n, prior, model.absent[kind])
    for kind in range(4):
        i = own + kind - 2
        there = n > own if kind >= 2 else own > 3
        f.told[kind] = few[i, width] if there else 0.0
    f.told[SLIPS] = f.slip[0]
    for kind in range(KINDS_OF_NUMBERS):
        f.told[LEVELS + kind] = math.exp(0.5 * f.level[0, kind])


@part
def collapse(f: Filter, i: int, n: int, prior: float, odds: float) -> None:
    """Average over whether the error of row i is there: moments are matched."""
    few, x, width = f.few, f.answer, len(f.few[0]) - 1
    p, m = few[i, i - 3], few[i, width]
    if odds == -math.inf or not p > 0.0:
        return
    there = 1.0 / (1.0 + math.exp(min(odds + 0.5 * math.log(prior / p) - 0.5 * m * m / p, 700.0)))
    mean, change = (there - 1.0) * m / p, (there * p + there * (1.0 - there) * m * m - p) / (p * p)
    for c in range(3):
        x[c] += mean * few[c, i - 3]
        for d in range(3):
            x[3 + 3 * c + d] += change * few[c, i - 3] * few[d, i - 3]
    for j in range(n):
        if j != i:
            few[j, width] += mean * few[j, i - 3]
            for k in range(i + 1, n):
                few[j, k - 3] += change * few[j, i - 3] * few[i, k - 3]
    few[i, width] = there * m
    for k in range(i + 1, n):
        few[i, k - 3] *= 1.0 + change * p
