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
"""Most of a squared normalised innovation that counts, and the mean of what counts where all is as assumed."""
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
    """After the ego's prediction: D + q."""
    first = 3 * f.g.block[0, PLACE]
    for c in range(3):
        f.made[0, c] += own[MOTION_VARIANCE + c]
        f.made[1, c] = f.g.p[first + c, first + c]


@part
def corrected(f: Filter) -> None:
    """After an update of the ego: D (P+ / P-)^2."""
    first = 3 * f.g.block[0, PLACE]
    for c in range(3):
        p, before = f.g.p[first + c, first + c], f.made[1, c]
        f.made[0, c] = min(f.made[0, c] * (p / before) ** 2, p) if before > 0.0 else 0.0
        f.made[1, c] = p


@part
def learn(f: Filter, kind: int, q: float, share: float) -> None:
    """Count a squared normalised innovation of which a level makes that share of the variance."""
    f.level[1, kind] += 0.5 * share * (min(q, SUDDEN) - USUAL)
    f.level[2, kind] += 0.5 * share * share


@part
def learn_fix(f: Filter) -> None:
    """Count the innovations of the ego's fix, axis by axis."""
    h = f.h
    for c in range(3):
        s = h.variance[c] + h.cov[4 * c]
        q = h.gap[c] * h.gap[c] / s
        learn(f, FIXES, q, h.variance[c] / s)
        learn(f, MOTIONS, q, f.made[0, c] / s)


@part
def learn_relative(f: Filter, c: int) -> None:
    """Count the innovation of a component of a relative measurement."""
    h, along = f.h, 0.0
    s = h.variance[c] + h.cov[4 * c]
    for i in range(3):
        along += h.weight[3 * c + i] ** 2 * f.made[0, i]
    learn(f, c, h.q[c], h.variance[c] / s)
    learn(f, MOTIONS, h.q[c], along / s)


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
