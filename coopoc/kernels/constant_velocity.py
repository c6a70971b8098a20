"""Velocity from fixes alone: a Kalman filter of a nearly constant velocity, whose noise follows its innovations.

Of fixes with the variance R, and a white acceleration of the density (w / T)^4 R, T the usual interval of fixes, the
gains depend on w alone. So a bank of filters, one for each w, needs neither R nor the density: the likelihood of each,
with R put at its best value, says which w has predicted best of late.

References:
    Bar-Shalom, Li, Kirubarajan, Estimation with applications to tracking and navigation, Wiley 2001, 6.2.2 (white
    acceleration) and 11.6 (static multiple models).
"""

from math import exp, inf, log, nan, sqrt

import numpy as np

from ..arrays import Floats
from .compiling.compile import compiled
from .compiling.small import add, inner_product, scale, store, subtract, vector_at

BANK = 0.02 * 1.6 ** np.arange(16)
"""w of each filter: from a straight road at a steady speed to fixes that hardly depend on each other."""
FIRST_FILTER = 6
"""Index of the filter that holds before the first innovation."""
REMEMBERS = 30.0
"""s, time constant of the filters' log likelihoods."""
PRIOR_COUNT = 6.0
"""Innovations that the stated R counts as, beside the measured ones."""
ACCELERATION = 5.0
"""m/s^2, most of a vehicle, twice which changes the way of a step while the filter follows."""
MIN_VARIANCE = 1e-12
"""m^2, least R."""
CLIP_STDS = 3.0
"""Standard deviations at which an innovation is clipped."""


@compiled
def constant_velocity(
    t: Floats, fixes: Floats, interval: float, gap: float, variance: float, speed: float, bank: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """(M, 3) velocity m/s after each fix, by this and those before; of the filter that has predicted best (M,) by how
    much a position's variance grows from the last fix to this one, and 1/s^2 the variance of the velocity, shares of R;
    and m^2 R as it has proved; (M,) m^2, by how much a position has moved otherwise than was predicted.

    An innovation beyond CLIP_STDS is clipped, as that of a wrong fix. Where the next is beyond, too, and a vehicle can
    drive from fix to fix, it has braked or turned, or its receiver has jumped: the filter begins anew with both fixes.

    Args:
        t: (M,) s, increasing.
        fixes: (M, 3) m, 0 on an axis that was not measured.
        interval: s, usual one of the fixes.
        gap: s, after which it begins anew.
        variance: m^2, R as it is stated, of a fix on an axis.
        speed: m/s, standard deviation of a velocity of which nothing is known.
        bank: (F,) w.
    """
    count, models = len(t), len(bank)
    velocity = np.zeros((count, 3))
    growth, spread, proved, moved = np.zeros((4, count))
    beyond = np.zeros(models, np.bool_)
    x, u, p, score = np.zeros((4, 3 * models))
    best, prior, last = FIRST_FILTER, PRIOR_COUNT, (0.0, 0.0, 0.0)
    for m in range(models):
        store(score, m, (prior, prior * variance, 0.0))
    for j in range(count):
        fix, dt = (fixes[j, 0], fixes[j, 1], fixes[j, 2]), t[j] - t[j - 1] if j > 0 else inf
        driven, last = subtract(fix, last), fix
        if dt > gap:
            for m in range(models):
                store(p, m, (1.0, 0.0, speed * speed / variance))
                store(x, m, fix)
                store(u, m, (0.0, 0.0, 0.0))
                beyond[m] = False
            growth[j], spread[j], proved[j] = nan, p[2], variance
            continue
        keep, most = exp(-dt / REMEMBERS), -inf
        for m in range(models):
            q, (before, b, d) = (bank[m] / interval) ** 4, vector_at(p, m)
            a = before + 2.0 * dt * b + dt * dt * d + q * dt**3 / 3.0
            b, d = b + dt * d + q * dt * dt / 2.0, d + q * dt
            ahead, (numbers, squares, logs) = scale(vector_at(u, m), dt), vector_at(score, m)
            at, turned, s = add(vector_at(x, m), ahead), subtract(driven, ahead), a + 1.0
            innovation = subtract(fix, at)
            square = inner_product(innovation, innovation)
            limit = 3.0 * CLIP_STDS**2 * max(squares / numbers, MIN_VARIANCE) * s
            clip = sqrt(limit / square) if square > limit else 1.0
            way, noise = ACCELERATION * dt * dt, CLIP_STDS * sqrt(2.0 * squares / numbers)
            again, beyond[m] = beyond[m], square > limit
            otherwise = again and beyond[m] and inner_product(turned, turned) < (2.0 * way + noise) ** 2
            doubted = beyond[m] and (otherwise or square < way**2)
            store(x, m, add(at, scale(innovation, clip * a / s)))
            store(u, m, add(vector_at(u, m), scale(innovation, clip * b / s)))
            store(p, m, (a / s, b / s, d - b * b / s))
            if otherwise:
                store(x, m, fix)
                store(u, m, scale(driven, 1.0 / dt))
                store(p, m, (1.0, 1.0 / dt, 2.0 / dt**2))
            numbers = prior + keep * (numbers - prior) + 3.0
            squares = prior * variance + keep * (squares - prior * variance) + min(square, limit) / s
            logs = keep * logs + 3.0 * log(s)
            store(score, m, (numbers, squares, logs))
            likely = -0.5 * (numbers * log(max(squares / numbers, MIN_VARIANCE)) + logs)
            if likely > most:
                best, most, growth[j], moved[j] = m, likely, a - before, square if doubted else 0.0
        store(velocity[j], 0, vector_at(u, best))
        spread[j], proved[j] = p[3 * best + 2], score[3 * best + 1] / score[3 * best]
    return velocity, growth, spread, proved, moved
