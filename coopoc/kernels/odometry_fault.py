"""Odometry that fails, as fixes show: wheels that stand still or run free, a compass that turns, a speed that freezes.

Two filters follow a vehicle on the ground, beside the one that wants its motion. One believes the odometry, the other
adds a velocity error b, a random walk. By how much likelier the second makes a fix is evidence, which adds up. Either
begins anew at a fix that is far beyond it: a receiver that jumps, and stays displaced, moves as the odometry says. From
DECISIVE on, if b is more than heading and scale err by, motions are corrected by b, until no evidence is left.

A receiver whose error grows steadily, by many of its deviations, looks the same to a vehicle that is alone.

References:
    Page, Continuous inspection schemes, Biometrika 41, 1954 (the cumulative sum); Bar-Shalom, Li, Kirubarajan,
    Estimation with applications to tracking and navigation, Wiley 2001, 6.2.2 (white acceleration).
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, part
from .motion import MotionNoise, keep_pace, process_variance

PLACE, ERROR, VARIANCE, BELIEVED, SURE, LEVEL, FIX, AGE = 0, 2, 4, 7, 9, 10, 11, 13
"""Places in a state: position m and b m/s with the variances and covariance (pp, pb, bb) of an axis, the position by
odometry alone and its variance, the level of the noise of fixes, the last fix m and how long ago it was s."""
EVIDENCE, SINCE, PATH, BEFORE, FAILS, SPEED, FASTEST, TRUE, PACE, Q, SIZE = 14, 15, 16, 17, 19, 20, 21, 22, 23, 26, 29
"""The evidence, for how long s and how far m there is some, where odometry alone has led since m, and whether it fails;
the most of late speeds, of all by odometry, and that with b, m/s; the square of the pace and the motion's variance."""
JERKY = 1.0
"""m^2/s^3, density of the acceleration of b."""
FAR = 16.0
"""Squared normalised innovation from which a filter begins anew, and the most that counts."""
DECISIVE, MOST = 15.0, 18.0
"""Evidence from which the odometry fails, and the most that is counted; logarithms of a likelihood ratio."""
SHARE, RATE, DEVIATIONS, LONG = 0.2, 0.5, 5.0, 2.0
"""Of the way, m for each second, and deviations of a fix: the odometry errs by as much at least, for as many s."""
FASTER = 2.0
"""Times the fastest by odometry that a vehicle may go, if that is above RATE."""
WANDERS = 2.0
"""s, in which the errors of all fixes may change together."""
NOISIER = 0.1
"""Share of what a fix says of the level of the noise of all, which is no less than it is stated."""
LATE = 10.0
"""s, for which a speed is remembered."""


@part
def correct(state: Floats, noise: MotionNoise, velocity: Floats, dt: float) -> float:
    """Add b to a velocity where the odometry fails, and return by how many m^2 its motion is more uncertain.

    Args:
        state: (SIZE,), NaN before the first fix; of no length where odometry is believed.
        noise: of the motion.
        velocity: (3,) m/s.
        dt: s.
    """
    if len(state) == 0 or math.isnan(state[PLACE]):
        return 0.0
    process_variance(noise, state[PACE:Q], velocity, dt, state[Q:SIZE])
    keep_pace(state[PACE:Q], velocity, dt)
    q, pb, bb, fails = 0.5 * (state[Q] + state[Q + 1]), state[VARIANCE + 1], state[VARIANCE + 2], state[FAILS] > 0.0
    speed, true = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2), 0.0
    for c in range(2):
        state[BEFORE + c] += dt * velocity[c]
        state[BELIEVED + c] += dt * velocity[c]
        state[PLACE + c] += dt * (velocity[c] + state[ERROR + c])
        true += (velocity[c] + state[ERROR + c]) ** 2
        velocity[c] += state[ERROR + c] if fails else 0.0
    state[TRUE], state[FASTEST] = math.sqrt(true), max(state[FASTEST], speed)
    speed = max(speed, state[TRUE]) if fails else speed
    state[SPEED] = max(state[SPEED] * math.exp(-dt / LATE), speed)
    state[PATH] += dt * speed
    state[SINCE] += dt
    state[AGE] += dt
    more = 2.0 * dt * pb + dt * dt * bb + JERKY * dt**3 / 3.0
    state[VARIANCE] += more + q
    state[VARIANCE + 1], state[VARIANCE + 2] = pb + dt * bb + 0.5 * JERKY * dt * dt, bb + JERKY * dt
    state[SURE] += q
    return more if fails else 0.0


@part
def judge(state: Floats, x: float, y: float, r: float) -> float:
    """Take a fix, m, NaN for none, whose axes have the variance r m^2; by how many m^2 the position is more uncertain
    than the odometry says if it has failed from now on."""
    if len(state) == 0 or math.isnan(x):
        return 0.0
    if math.isnan(state[PLACE]):
        state[:] = 0.0
        state[VARIANCE], state[VARIANCE + 2], state[SURE], state[LEVEL] = r, 1.0, r, 1.0
        for at in (PLACE, BELIEVED, FIX, BEFORE):
            state[at], state[at + 1] = x, y
        state[PACE:Q] = math.nan
        return 0.0
    if x == state[FIX] and y == state[FIX + 1]:  # to all digits: the receiver holds it
        return 0.0
    failed, state[FIX], state[FIX + 1] = state[FAILS] > 0.0, x, y
    r *= state[LEVEL]
    gather_evidence(state, r)
    gap = math.sqrt((state[PLACE] - state[BEFORE]) ** 2 + (state[PLACE + 1] - state[BEFORE + 1]) ** 2)
    least = max(SHARE * state[PATH], RATE * state[SINCE], DEVIATIONS * math.sqrt(r))
    size = math.sqrt(state[ERROR] ** 2 + state[ERROR + 1] ** 2) * state[SINCE]
    if state[EVIDENCE] > DECISIVE and state[SINCE] > LONG and min(gap, size) > least:
        state[FAILS] = 1.0
    return gap * gap if state[FAILS] > 0.0 and not failed else 0.0


@part
def gather_evidence(state: Floats, r: float) -> None:
    """Update both filters by the fix, and the evidence."""
    state[SURE], state[AGE] = max(state[SURE], r * state[AGE] / WANDERS), 0.0
    s, sure = state[VARIANCE] + r, state[SURE] + r
    square = believed = 0.0
    for c in range(2):
        square += (state[FIX + c] - state[PLACE + c]) ** 2 / s
        believed += (state[FIX + c] - state[BELIEVED + c]) ** 2 / sure
    anew, gain = square > FAR, state[VARIANCE + 1] / s
    share, trust = 1.0 if anew else state[VARIANCE] / s, 1.0 if believed > FAR else state[SURE] / sure
    for c in range(2):
        gap = state[FIX + c] - state[PLACE + c]
        state[PLACE + c] += share * gap
        state[BEFORE + c] += gap if anew else 0.0
        state[ERROR + c] += 0.0 if anew else gain * gap
        state[BELIEVED + c] += trust * (state[FIX + c] - state[BELIEVED + c])
    if anew:
        state[VARIANCE], state[VARIANCE + 1] = r, 0.0
        state[VARIANCE + 2] = max(state[VARIANCE + 2], state[SPEED] ** 2)
    else:
        state[VARIANCE + 2] -= gain * state[VARIANCE + 1]
        state[VARIANCE], state[VARIANCE + 1] = share * r, (1.0 - share) * state[VARIANCE + 1]
    state[SURE] = trust * r
    state[LEVEL] = max(state[LEVEL] * math.exp(NOISIER * (0.5 * min(square, FAR) - 1.0)), 1.0)
    state[EVIDENCE] += 0.5 * (min(believed, FAR) - min(square, FAR)) + math.log(sure / s)
    too_fast = state[TRUE] > FASTER * state[FASTEST] and state[FASTEST] > RATE
    state[EVIDENCE] = 0.0 if too_fast else min(max(state[EVIDENCE], 0.0), MOST)
    if state[EVIDENCE] == 0.0:
        state[FAILS] = state[PATH] = state[SINCE] = 0.0
        state[BEFORE], state[BEFORE + 1] = state[PLACE], state[PLACE + 1]


@compiled
def correct_drives(
    gnss: Floats, velocity: Floats, noise: MotionNoise, variance: Floats, columns: Ints, dt: float
) -> tuple[Floats, Floats]:
    """Velocities (R, T, E, 3) m/s of the columns, corrected where their odometry fails, and by how many m^2 the
    variance of each motion is larger (R, T, E).

    Args:
        gnss: (R, T, N, 3) m, NaN for no fix.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle, which begins anew.
        noise: of motions.
        variance: (3,) m^2 of a fix.
        columns: (E,) of the vehicles.
        dt: s.
    """
    runs, steps = gnss.shape[:2]
    out, more = np.empty((runs, steps, len(columns), 3)), np.zeros((runs, steps, len(columns)))
    state, r = np.empty(SIZE), 0.5 * (variance[0] + variance[1])
    for run in range(runs):
        for e in range(len(columns)):
            n = columns[e]
            state[:] = math.nan
            for t in range(steps):
                for c in range(3):
                    out[run, t, e, c] = velocity[run, t, n, c]
                if math.isnan(velocity[run, t, n, 0]):
                    state[:] = math.nan
                    continue
                if t > 0:
                    more[run, t, e] = correct(state, noise, out[run, t, e], dt)
                more[run, t, e] += judge(state, gnss[run, t, n, 0], gnss[run, t, n, 1], r)
    return out, more
