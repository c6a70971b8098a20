"""Levels: by how much the variance of each kind of number differs from what is assumed, as its innovations show.

The log-likelihood of an innovation v ~ N(0, S) has the derivative s (v^2 / S - 1) / 2 by the logarithm of a level, with
s the share of S that the level makes, and the information s^2 / 2. Each step moves a level by the sum of its
derivatives over their information, which is forgotten in `Guards.forget` s. Of the ego's motion the share is
D = dP / d log level, which a step of prediction makes D + q, and an update D (P+ / P-)^2.

References:
    Ljung, Soderstrom, Theory and Practice of Recursive Identification, MIT Press, 1983, chapter 3.
"""

from __future__ import annotations

import math

from ...arrays import Floats
from ..compiling.compile import part
from .cooperative_state import FIXES, KINDS_OF_NUMBERS, MOTION_VARIANCE, MOTIONS, STEP, Filter, Guards
from .gaussian import PLACE

SUDDEN, USUAL = 5.0, 0.95
"""Most of a squared normalised innovation that counts, and the mean of what counts of one number that is as assumed."""
QUIETEST, LOUDEST, FASTEST = -2.0, 3.5, 0.5
"""Least and most logarithm of a level, and the most that it changes in a step."""
PRIOR = 10.0
"""Information that the assumed level counts as: that of twenty numbers."""


@part
def louder(f: Filter, own: Floats, rows: Floats, count: int) -> None:
    """Multiply the variances of a step's motions by their level."""
    level = math.exp(f.level[0, MOTIONS])
    for c in range(3):
        own[MOTION_VARIANCE + c] *= level
        for i in range(count):
            rows[i, STEP + c] *= level


@part
def moved(f: Filter, own: Floats) -> None:
    """After the ego's prediction: D + q, both of the three axes together, so that no axis of the world counts."""
    f.made[0] += own[MOTION_VARIANCE] + own[MOTION_VARIANCE + 1] + own[MOTION_VARIANCE + 2]
    f.made[1] = ego_variance(f)


@part
def corrected(f: Filter) -> None:
    """After an update of the ego: D (P+ / P-)^2."""
    p, before = ego_variance(f), f.made[1]
    f.made[0] = min(f.made[0] * (p / before) ** 2, p) if before > 0.0 else 0.0
    f.made[1] = p


@part
def ego_variance(f: Filter) -> float:
    """m^2, of the three axes together."""
    first = 3 * f.g.block[0, PLACE]
    total: float = f.g.p[first, first] + f.g.p[first + 1, first + 1] + f.g.p[first + 2, first + 2]
    return total


@part
def learn(f: Filter, kind: int, more: float, share: float, numbers: float) -> None:
    """Count by how much squared normalised innovations are more than usual, of which a level makes that share."""
    f.level[1, kind] += 0.5 * numbers * share * more
    f.level[2, kind] += 0.5 * numbers * share * share


@part
def learn_fix(f: Filter) -> None:
    """Count the innovation of the ego's fix."""
    h, square, r, s = f.h, 0.0, 0.0, 0.0
    for c in range(3):
        square += h.gap[c] * h.gap[c]
        r += h.variance[c]
        s += h.variance[c] + h.cov[4 * c]
    more = min(square / s, SUDDEN) - 1.0
    learn(f, FIXES, more, r / s, 3.0)
    learn(f, MOTIONS, more, f.made[0] / s, 3.0)


@part
def learn_relative(f: Filter, c: int) -> None:
    """Count the innovation of a component of a relative measurement."""
    h, along = f.h, 0.0
    s, more = h.variance[c] + h.cov[4 * c], min(h.q[c], SUDDEN) - USUAL
    for i in range(3):
        along += h.weight[3 * c + i] ** 2 * f.made[0] / 3.0
    learn(f, c, more, h.variance[c] / s, 1.0)
    learn(f, MOTIONS, more, along / s, 1.0)


@part
def adapt(f: Filter, guards: Guards) -> None:
    """Move the levels by what this step has shown."""
    if guards.forget == 0.0:
        return
    keep = math.exp(-f.clock[1] / guards.forget)
    for kind in range(KINDS_OF_NUMBERS):
        change = f.level[1, kind] / (f.level[2, kind] + PRIOR)
        level = f.level[0, kind] + min(max(change, -FASTEST), FASTEST)
        f.level[0, kind] = min(max(level, QUIETEST), LOUDEST)
        f.level[1, kind] = 0.0
        f.level[2, kind] *= keep
