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

BANK = 0.02 * 1.6 ** np.arange(16)
"""w of each filter: from a straight road at a steady speed to fixes that hardly depend on each other."""
FIRST_FILTER = 6
"""Index of the filter that holds before the first innovation."""
REMEMBERS = 30.0
"""s, time constant of the filters' log likelihoods."""
PRIOR_COUNT = 6.0
"""Innovations that the stated R counts as, beside the measured ones."""
MIN_VARIANCE = 1e-12
"""m^2, least R."""
CLIP_STDS = 3.0
"""Standard deviations at which an innovation is clipped."""


@compiled
def constant_velocity(
    t: Floats, fixes: Floats, interval: float, gap: float, variance: float, speed: float, bank: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """(M, 3) velocity m/s after each fix, by this and those before; of the filter that has predicted best (M,) by how
    much a position's variance grows from the last fix to this one, and 1/s^2 the variance of the velocity, shares of R;
    and m^2 R as it has proved.

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
    growth, spread, proved = np.zeros((3, count))
    x, u, p, score = np.zeros((4, models, 3))
    v, best, prior = np.zeros(3), FIRST_FILTER, PRIOR_COUNT
    score[:, 0], score[:, 1] = prior, prior * variance
    for j in range(count):
        dt = t[j] - t[j - 1] if j > 0 else inf
        if dt > gap:
            for m in range(models):
                p[m, 0], p[m, 1], p[m, 2] = 1.0, 0.0, speed * speed / variance
                for c in range(3):
                    x[m, c], u[m, c] = fixes[j, c], 0.0
            growth[j], spread[j], proved[j] = nan, p[0, 2], variance
            continue
        keep, most = exp(-dt / REMEMBERS), -inf
        for m in range(models):
            q, (before, b, d) = (bank[m] / interval) ** 4, p[m]
            a = before + 2.0 * dt * b + dt * dt * d + q * dt**3 / 3.0
            b, d = b + dt * d + q * dt * dt / 2.0, d + q * dt
            s, square = a + 1.0, 0.0
            for c in range(3):
                x[m, c] += dt * u[m, c]
                v[c] = fixes[j, c] - x[m, c]
                square += v[c] * v[c]
            numbers, squares, logs = score[m]
            limit = 3.0 * CLIP_STDS**2 * max(squares / numbers, MIN_VARIANCE) * s
            clip = sqrt(limit / square) if square > limit else 1.0
            for c in range(3):
                x[m, c] += clip * a / s * v[c]
                u[m, c] += clip * b / s * v[c]
            p[m, 0], p[m, 1], p[m, 2] = a / s, b / s, d - b * b / s
            numbers = prior + keep * (numbers - prior) + 3.0
            squares = prior * variance + keep * (squares - prior * variance) + min(square, limit) / s
            logs = keep * logs + 3.0 * log(s)
            score[m, 0], score[m, 1], score[m, 2] = numbers, squares, logs
            likely = -0.5 * (numbers * log(max(squares / numbers, MIN_VARIANCE)) + logs)
            if likely > most:
                best, most, growth[j] = m, likely, a - before
        for c in range(3):
            velocity[j, c] = u[best, c]
        spread[j], proved[j] = p[best, 2], score[best, 1] / score[best, 0]
    return velocity, growth, spread, proved
