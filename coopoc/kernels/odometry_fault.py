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

import math

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, part
from .motion import MotionNoise

PLACE, ERROR, VARIANCE, BELIEVED, SURE_UNTIL, LEVEL, FAILS, EVIDENCE = 0, 2, 4, 7, 9, 10, 11, 12
LASTS, PATH, BEFORE, SPEED, FASTEST = 13, 14, 15, 17, 18
"""Places in a state, when fixes were last taken: position m and b m/s with the variances and covariance (pp, pb, bb)
of an axis, the position by odometry alone and its variance, and the level of the noise of fixes; whether the odometry
fails, the evidence, for how long s and how far m there is some, and where odometry alone has led since m; squares of
the most of late speeds and of all by odometry m^2/s^2."""
WAY, SINCE, FIX, GAPS, TIMES, COUNT, BASE, RATIO, FLOOR, INTERVAL, SIZE = 19, 21, 22, 24, 26, 27, *range(28, 33)
"""Since then: the way by odometry m, the time s; the last fix m, sums of how far fixes were from the position and the
way m, and of their times s, and how many there were; and, all the time, the numbers of a MotionNoise, base and
ratio squared."""
TOGETHER = 0.4
"""s, interval whose fixes are averaged into one."""
JERKY = 1.0
"""m^2/s^3, density of the acceleration of b."""
RESTART_Q, MAX_Q = 14.0, 25.0
"""Squared normalised innovation from which a filter begins anew, and the most that counts as evidence."""
DECISIVE, MAX_EVIDENCE = 15.0, 18.0
"""Evidence, a log likelihood ratio, from which the odometry fails, and the most that is counted."""
ERRS_SHARE, ERRS_RATE, ERRS_STDS, ERRS_SECONDS = 0.2, 0.5, 5.0, 2.0
"""Least error of an odometry that fails, as a share of the way, in m for each second, and in standard deviations of a
fix; and s for which it must last."""
FASTER = 4.0
"""Times the fastest by odometry that a vehicle may go, if that is above ERRS_RATE: m/s for km/h make it 3.6."""
WANDERS = 2.0
"""s, in which the errors of all fixes may change together."""
NOISIER, UNKNOWN = 0.1, 4.0
"""Share of what fixes say of the level of the noise of all, which is no less than it is stated, and what it is taken
for at first, and that of odometry all the time."""
SPEED_MEMORY = 10.0
"""s, for which a speed is remembered."""


def new_state(noise: MotionNoise) -> Floats:
    """(SIZE,) before the first fix.

    Args:
        noise: of the motion.
    """
    state = np.full(SIZE, math.nan)
    base, ratio = (float(np.square(std[:2]).mean()) for std in (noise.base, noise.ratio))
    state[BASE:] = base, ratio, noise.floor, noise.interval
    return state


@part
def correct(state: Floats, velocity: Floats, dt: float) -> float:
    """Add b to a velocity (3,) m/s where the odometry fails, and return by how many m^2 its motion is more uncertain.

    Args:
        state: of `new_state`, or of no length where odometry is believed.
        velocity: (3,) m/s.
        dt: s.
    """
    if len(state) == 0 or math.isnan(state[PLACE]):
        return 0.0
    state[WAY] += dt * velocity[0]
    state[WAY + 1] += dt * velocity[1]
    state[SINCE] += dt
    if state[FAILS] == 0.0:
        return 0.0
    velocity[0] += state[ERROR]
    velocity[1] += state[ERROR + 1]
    grown = dt * (2.0 * state[SINCE] - dt) * state[VARIANCE + 2]
    return float(2.0 * dt * state[VARIANCE + 1] + grown + JERKY * dt**3 / 3.0)


@part
def judge(state: Floats, x: float, y: float, r: float, dt: float) -> float:
    """Take a fix, m, NaN for none, whose axes have the variance r m^2; by how many m^2 the position is more uncertain
    than the odometry says if it has failed from now on."""
    if len(state) == 0 or math.isnan(x):
        return 0.0
    if math.isnan(state[PLACE]):
        for i in range(BASE):
            state[i] = 0.0
        state[VARIANCE], state[VARIANCE + 2], state[SURE_UNTIL], state[LEVEL] = r, 1.0, r, UNKNOWN
        state[PLACE] = state[BELIEVED] = state[BEFORE] = state[FIX] = x
        state[PLACE + 1] = state[BELIEVED + 1] = state[BEFORE + 1] = state[FIX + 1] = y
        return 0.0
    if x == state[FIX] and y == state[FIX + 1]:  # to all digits: the receiver holds it
        return 0.0
    state[FIX], state[FIX + 1], n, r = x, y, state[COUNT], r * state[LEVEL]
    east, north = x - state[PLACE] - state[WAY], y - state[PLACE + 1] - state[WAY + 1]
    if (n * east - state[GAPS]) ** 2 + (
        n * north - state[GAPS + 1]
    ) ** 2 > 2.0 * n * n * RESTART_Q * r:  # it has jumped
        state[GAPS] = state[GAPS + 1] = state[TIMES] = state[COUNT] = 0.0
    state[GAPS] += east
    state[GAPS + 1] += north
    state[TIMES] += state[SINCE]
    state[COUNT] += 1.0
    if state[SINCE] < TOGETHER - 0.5 * dt:
        return 0.0
    failed = state[FAILS] > 0.0
    gather_evidence(state, r / state[COUNT], dt)
    if failed or state[EVIDENCE] < DECISIVE or state[LASTS] < ERRS_SECONDS:
        return 0.0
    gap2 = (state[PLACE] - state[BEFORE]) ** 2 + (state[PLACE + 1] - state[BEFORE + 1]) ** 2
    size2 = (state[ERROR] ** 2 + state[ERROR + 1] ** 2) * state[LASTS] ** 2
    least = max(ERRS_SHARE * state[PATH], ERRS_RATE * state[LASTS], ERRS_STDS * math.sqrt(r))
    if min(gap2, size2) < least * least:
        return 0.0
    state[FAILS] = 1.0
    return float(gap2)


@part
def gather_evidence(state: Floats, r: float, dt: float) -> None:
    """Move both filters on, and update them and the evidence by the mean of the fixes since, of variance r m^2."""
    time, interval = state[SINCE], state[INTERVAL] if state[INTERVAL] > 0.0 else dt
    east, north = state[WAY] / time, state[WAY + 1] / time
    speed2, true2 = east**2 + north**2, (east + state[ERROR]) ** 2 + (north + state[ERROR + 1]) ** 2
    state[FASTEST] = max(state[FASTEST], speed2)
    speed2 = max(speed2, true2) if state[FAILS] > 0.0 else speed2
    state[SPEED] = max(state[SPEED] * max(1.0 - 2.0 * time / SPEED_MEMORY, 0.0), speed2)
    q = state[BASE] + interval**2 * max(state[RATIO] * speed2, state[FLOOR] ** 2)
    q *= UNKNOWN * time / interval
    p, pb, bb = state[VARIANCE], state[VARIANCE + 1], state[VARIANCE + 2]
    p += 2.0 * time * pb + time * time * bb + JERKY * time**3 / 3.0 + q
    pb, bb = pb + time * bb + 0.5 * JERKY * time * time, bb + JERKY * time
    sure = max(state[SURE_UNTIL] + q, r * time / WANDERS)
    s, wide = p + r, sure + r
    square = believed = 0.0
    for c in range(2):
        gap, moved = state[GAPS + c] / state[COUNT], state[WAY + c] + time * state[ERROR + c]
        state[GAPS + c] = gap - state[ERROR + c] * state[TIMES] / state[COUNT]
        square += state[GAPS + c] ** 2 / s
        gap += state[PLACE + c] - state[BELIEVED + c]
        believed += gap**2 / wide
        state[PLACE + c] += moved
        state[BEFORE + c] += state[WAY + c]
        state[BELIEVED + c] += state[WAY + c]
        state[WAY + c] = gap  # until the update below
    anew, gain = square > RESTART_Q, pb / s
    share, trust = 1.0 if anew else p / s, 1.0 if believed > RESTART_Q else sure / wide
    for c in range(2):
        gap = state[GAPS + c]
        state[PLACE + c] += share * gap
        state[BEFORE + c] += gap if anew else 0.0
        state[ERROR + c] += 0.0 if anew else gain * gap
        state[BELIEVED + c] += trust * state[WAY + c]
        state[GAPS + c] = state[WAY + c] = 0.0
    bb = max(bb, state[SPEED]) if anew else bb - gain * pb
    state[VARIANCE], state[VARIANCE + 1], state[VARIANCE + 2] = share * r, (1.0 - share) * pb, bb
    state[SURE_UNTIL] = trust * r
    state[LEVEL] = max(state[LEVEL] * (1.0 + NOISIER * (0.5 * min(square, MAX_Q) - 1.0)), 1.0)
    state[LASTS] += time
    state[PATH] += time * math.sqrt(speed2)
    more = 0.5 * (min(believed, MAX_Q) - min(square, MAX_Q)) + math.log(wide / s)
    too_fast = true2 > FASTER**2 * state[FASTEST] and state[FASTEST] > ERRS_RATE**2
    state[EVIDENCE] = 0.0 if too_fast else min(max(state[EVIDENCE] + more, 0.0), MAX_EVIDENCE)
    if state[EVIDENCE] == 0.0:
        state[FAILS] = state[PATH] = state[LASTS] = 0.0
        state[BEFORE], state[BEFORE + 1] = state[PLACE], state[PLACE + 1]
    state[SINCE] = state[TIMES] = state[COUNT] = 0.0


@compiled
def correct_drives(
    gnss: Floats,
    velocity: Floats,
    fresh: Floats,
    variance: Floats,
    columns: Ints,
    dt: float,
    out: Floats,
) -> bool:
    """Whether the odometry of one of the columns fails; write what then corrects it.

    Args:
        gnss: (R, T, N, 3) m, NaN for no fix.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle, which begins anew.
        fresh: of `new_state`.
        variance: (T, N, 3) m^2 of a fix.
        columns: (E,) of the vehicles.
        dt: s.
        out: (R, T, N, 3) of a velocity east and north m/s, and by how much a motion's variance is larger m^2; of no
            length only to ask.
    """
    states, moved = np.empty((len(columns), SIZE)), np.empty(3)
    fails = False
    for run in range(gnss.shape[0]):
        for e in range(len(columns)):
            for i in range(SIZE):
                states[e, i] = fresh[i]
        for t in range(gnss.shape[1]):
            for e in range(len(columns)):
                n, extra, state = columns[e], 0.0, states[e]
                moved[0], moved[1] = velocity[run, t, n, 0], velocity[run, t, n, 1]
                if math.isnan(moved[0]):
                    state[PLACE] = math.nan
                    continue
                if t > 0:
                    extra = correct(state, moved, dt)
                r = 0.5 * (variance[t, n, 0] + variance[t, n, 1])
                extra += judge(state, gnss[run, t, n, 0], gnss[run, t, n, 1], r, dt)
                fails = fails or extra > 0.0
                if len(out):
                    out[run, t, n, 0] = moved[0] - velocity[run, t, n, 0]
                    out[run, t, n, 1], out[run, t, n, 2] = moved[1] - velocity[run, t, n, 1], extra
    return fails
