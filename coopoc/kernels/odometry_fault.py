"""Odometry that fails, as fixes show: wheels that stand still, a compass that turns, a speed that freezes, a current.

Two filters follow a vehicle on the ground, beside the one that wants its motion. One believes the odometry, the other
adds a velocity error b, a random walk. By how much likelier the second makes a fix is evidence, which adds up. Either
begins anew at a fix that is far beyond it: a receiver that jumps, and stays displaced, moves as the odometry says.
Where the second does so once more while there is evidence, fixes leap rather than the odometry, and evidence is lost.
From DECISIVE on, if b is more than heading and scale err by, motions are corrected by b, until no evidence is left.

This is done for each of two PACES of the random walk. The slow one finds errors of a twentieth of the way that last;
the fast one those that are large, and begin and change at once.

A receiver whose error grows steadily, by many of its deviations, looks the same to a vehicle that is alone.

References:
    Page, Continuous inspection schemes, Biometrika 41, 1954 (the cumulative sum); Bar-Shalom, Li, Kirubarajan,
    Estimation with applications to tracking and navigation, Wiley 2001, 6.2.2 (white acceleration).
"""

from math import isnan, log, nan, sqrt

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
WAY, SINCE, FIX, GAPS, TIMES, WEIGHT, FINEST, LIKELY, BASE, RATIO, FLOOR, INTERVAL = 19, 21, 22, 24, *range(26, 34)
"""Since then: the way by odometry m, the time s; the last fix m, weighted sums of how far fixes were from the position
and the way m, and of their times s, and of the weights, 1 / variance m^-2; the largest weight of late fixes; the
logarithm of how likely they were; and, all the time, the numbers of a MotionNoise, base and ratio squared."""
WALK, FIRST, LATER, SHARE, RATE, STDS, DURATION, AGAIN, SIZE = range(34, 43)
"""The numbers of a pace; and 1 once the second filter has begun anew while there is evidence."""
PACES = ((0.001, 6.0, 6.0, 0.05, 0.1, 30.0, 60.0), (1.0, 0.0, 10.0, 0.2, 0.5, 5.0, 2.0))
"""Of the random walks of b: the density of its acceleration m^2/s^3; the evidence that its filter loses where it begins
anew, and where it does so once more; and the least error of an odometry that fails, as a share of the way, in m for
each second, and in standard deviations of a fix, MAX_WANDER_M at most, and for how many s it lasts."""
AVERAGED_FIXES_S = 0.4
"""s, interval whose fixes are averaged into one."""
RESTART_Q, MAX_Q = 14.0, 25.0
"""Squared normalised innovation from which a filter begins anew, and the most that counts as evidence."""
DECISIVE, MAX_EVIDENCE = 15.0, 18.0
"""Evidence, a log likelihood ratio, from which the odometry fails, and the most that is counted."""
FASTER = 4.0
"""Times the fastest by odometry that a vehicle may go, if that is above RATE: m/s for km/h make it 3.6."""
WANDERS, MAX_WANDER_M = 2.0, 100.0
"""s, in which the errors of all fixes may change together, and m, farther than which these do not wander, however noisy
fixes are."""
NOISIER, UNKNOWN = 0.1, 4.0
"""Share of what fixes say of the level of the noise of all, which is no less than it is stated, and what it is taken
for at first, and that of odometry all the time."""
SPEED_MEMORY_S, LIKELY_KEPT = 10.0, 0.9
"""s, for which a speed and the largest weight are remembered; share of LIKELY that is left at the next fix."""


def new_state(noise: MotionNoise) -> Floats:
    """(2, SIZE) before the first fix, one row for each pace.

    Args:
        noise: of the motion.
    """
    states = np.full((len(PACES), SIZE), nan)
    base, ratio = (float(np.square(std[:2]).mean()) for std in (noise.base, noise.ratio))
    for state, pace in zip(states, PACES, strict=True):
        state[BASE:AGAIN] = base, ratio, noise.floor, noise.interval, *pace
    return states


@part
def failing(states: Floats) -> int:
    """Row of the pace that corrects: of those at which the odometry fails the likelier of late; -1 for none."""
    likeliest = -1
    for i in range(len(states)):
        if states[i, FAILS] > 0.0 and (likeliest < 0 or states[i, LIKELY] > states[likeliest, LIKELY]):
            likeliest = i
    return likeliest


@part
def correct(states: Floats, velocity: Floats, dt: float) -> float:
    """Add b to a velocity (3,) m/s where the odometry fails, and return by how many m^2 its motion is more uncertain.

    Args:
        states: of `new_state`, or of no length where odometry is believed.
        velocity: (3,) m/s.
        dt: s.
    """
    if len(states) == 0 or isnan(states[0, PLACE]):
        return 0.0
    for i in range(len(states)):
        states[i, WAY] += dt * velocity[0]
        states[i, WAY + 1] += dt * velocity[1]
        states[i, SINCE] += dt
    i = failing(states)
    if i < 0:
        return 0.0
    state = states[i]
    velocity[0] += state[ERROR]
    velocity[1] += state[ERROR + 1]
    grown = dt * (2.0 * state[SINCE] - dt) * state[VARIANCE + 2]
    return float(2.0 * dt * state[VARIANCE + 1] + grown + state[WALK] * dt**3 / 3.0)


@part
def judge(states: Floats, x: float, y: float, r: float, dt: float) -> float:
    """Take a fix, m, NaN for none, whose axes have the variance r m^2; by how many m^2 the position is more uncertain
    than the odometry says if it has failed from now on."""
    if len(states) == 0 or isnan(x):
        return 0.0
    before, gap2 = failing(states), 0.0
    for i in range(len(states)):
        gap2 = max(gap2, judge_pace(states[i], x, y, r, dt))
    return gap2 if before < 0 else 0.0


@part
def judge_pace(state: Floats, x: float, y: float, r: float, dt: float) -> float:
    """The square, m^2, of the gap between both filters of a pace at a fix from which on the odometry fails, else 0."""
    if isnan(state[PLACE]):
        state[:BASE] = state[AGAIN] = 0.0
        state[VARIANCE], state[VARIANCE + 2], state[SURE_UNTIL], state[LEVEL] = r, 1.0, r, UNKNOWN
        for k in (PLACE, BELIEVED, BEFORE, FIX):
            state[k], state[k + 1] = x, y
        return 0.0
    if x == state[FIX] and y == state[FIX + 1]:  # to all digits: the receiver holds it
        return 0.0
    state[FIX], state[FIX + 1], n, weight, r = x, y, state[WEIGHT], 1.0 / r, r * state[LEVEL]
    east, north = x - state[PLACE] - state[WAY], y - state[PLACE + 1] - state[WAY + 1]
    most = RESTART_Q * n * (n * r + max(n * r, state[LEVEL]))
    if (n * east - state[GAPS]) ** 2 + (n * north - state[GAPS + 1]) ** 2 > most:  # it has jumped
        state[GAPS:FINEST] = 0.0
    state[GAPS] += weight * east
    state[GAPS + 1] += weight * north
    state[TIMES] += weight * state[SINCE]
    state[WEIGHT] += weight
    state[FINEST] = max(state[FINEST], weight)
    if state[SINCE] < AVERAGED_FIXES_S - 0.5 * dt:
        return 0.0
    failed = state[FAILS] > 0.0
    gather_evidence(state, dt)
    if failed or state[EVIDENCE] < DECISIVE or state[LASTS] < state[DURATION]:
        return 0.0
    gap2 = (state[PLACE] - state[BEFORE]) ** 2 + (state[PLACE + 1] - state[BEFORE + 1]) ** 2
    size2 = (state[ERROR] ** 2 + state[ERROR + 1] ** 2) * state[LASTS] ** 2
    least = max(state[SHARE] * state[PATH], state[RATE] * state[LASTS], min(state[STDS] * sqrt(r), MAX_WANDER_M))
    if min(gap2, size2) < least * least:
        return 0.0
    state[FAILS] = 1.0
    return float(gap2)


@part
def gather_evidence(state: Floats, dt: float) -> None:
    """Move both filters on, and update them and the evidence by the weighted mean of the fixes since."""
    weight, time, interval = state[WEIGHT], state[SINCE], state[INTERVAL] if state[INTERVAL] > 0.0 else dt
    r = state[LEVEL] / weight
    east, north = state[WAY] / time, state[WAY + 1] / time
    speed2, true2 = east**2 + north**2, (east + state[ERROR]) ** 2 + (north + state[ERROR + 1]) ** 2
    state[FASTEST] = max(state[FASTEST], speed2)
    speed2 = max(speed2, true2) if state[FAILS] > 0.0 else speed2
    state[SPEED] = max(state[SPEED] * max(1.0 - 2.0 * time / SPEED_MEMORY_S, 0.0), speed2)
    q = state[BASE] + interval**2 * max(state[RATIO] * speed2, state[FLOOR] ** 2)
    q *= UNKNOWN * time / interval
    p, pb, bb = state[VARIANCE:BELIEVED]
    p += 2.0 * time * pb + time * time * bb + state[WALK] * time**3 / 3.0 + q
    pb, bb = pb + time * bb + 0.5 * state[WALK] * time * time, bb + state[WALK] * time
    sure = max(state[SURE_UNTIL] + q, r * min(weight / state[FINEST], 1.0) * time / WANDERS)
    s, wide = p + r, sure + r
    square = believed = 0.0
    for c in range(2):
        gap, moved = state[GAPS + c] / weight, state[WAY + c] + time * state[ERROR + c]
        state[GAPS + c] = gap - state[ERROR + c] * state[TIMES] / weight
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
    bb = max(bb, state[SPEED]) if anew else bb - gain * pb
    state[VARIANCE:BELIEVED] = share * r, (1.0 - share) * pb, bb
    state[SURE_UNTIL] = trust * r
    state[LEVEL] = max(state[LEVEL] * (1.0 + NOISIER * (0.5 * min(square, MAX_Q) - 1.0)), 1.0)
    state[LIKELY] = LIKELY_KEPT * state[LIKELY] - 0.5 * min(square, MAX_Q) - log(s)
    state[LASTS] += time
    state[PATH] += time * sqrt(speed2)
    more = 0.5 * (min(believed, MAX_Q) - min(square, MAX_Q)) + log(wide / s)
    if anew:
        more -= state[LATER] if state[AGAIN] > 0.0 else state[FIRST]
        state[AGAIN] = 1.0
    too_fast = true2 > FASTER**2 * state[FASTEST] and state[FASTEST] > state[RATE] ** 2
    state[EVIDENCE] = 0.0 if too_fast else min(max(state[EVIDENCE] + more, 0.0), MAX_EVIDENCE)
    if state[EVIDENCE] == 0.0:
        state[FAILS] = state[PATH] = state[LASTS] = state[AGAIN] = 0.0
        state[BEFORE], state[BEFORE + 1] = state[PLACE], state[PLACE + 1]
    state[FINEST] /= 1.0 + time / SPEED_MEMORY_S
    state[WAY:FIX] = state[GAPS:FINEST] = 0.0


@compiled
def correct_drives(
    gnss: Floats, velocity: Floats, fresh: Floats, variance: Floats, columns: Ints, dt: float, out: Floats
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
    states, moved = np.empty((len(columns), *fresh.shape)), np.empty(3)
    fails = False
    for run in range(gnss.shape[0]):
        states[:] = fresh
        for t in range(gnss.shape[1]):
            for e in range(len(columns)):
                n, extra, state = columns[e], 0.0, states[e]
                measured = velocity[run, t, n]
                moved[0], moved[1] = measured[0], measured[1]
                if isnan(moved[0]):
                    state[:, PLACE] = nan
                    continue
                if t > 0:
                    extra = correct(state, moved, dt)
                r = 0.5 * (variance[t, n, 0] + variance[t, n, 1])
                extra += judge(state, gnss[run, t, n, 0], gnss[run, t, n, 1], r, dt)
                fails = fails or extra > 0.0
                if len(out):
                    by = out[run, t, n]
                    by[0], by[1], by[2] = moved[0] - measured[0], moved[1] - measured[1], extra
    return fails
