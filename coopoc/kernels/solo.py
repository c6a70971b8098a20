"""Solo filters on position, axis by axis: one step, run over a whole drive or fed by a stream.

The state of an axis is (x, share, motion, noise, weight): its position m, whose variance is share * noise + motion m^2,
where `noise` m^2 is the variance of a fix as it is believed now and `weight` the number of fixes behind that belief.
With an infinite weight the noise is known, and the filter is the Kalman filter, whose variance is all in `motion`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..arrays import AnyArray, Floats, Ints
from .compiling.compile import compiled, part
from .motion import ROUNDING, MotionNoise, process_variance, push, since

LEAST = 1e-4
"""m^2, least variance of a fix: 1 cm."""
ESTIMATE, NO_FIX_YET, BAD_INPUT, HISTORY_FULL = 0, 1, 2, 3
"""What a step of a stream returns."""
GNSS, VELOCITY, DT, FIX_AGE = slice(0, 3), slice(3, 6), 6, 7
"""Where the input of a stream's step stands in its array."""


class FixNoise(NamedTuple):
    """The noise of fixes: known, or revised at each of them.

    Attributes:
        variance: (3,) m^2 at the start.
        weight: fixes that the start counts for; infinite: known.
        window: most fixes in the running mean.
        rho: forgetting per fix.
        iterations: of the variational fixed point; 0: running mean.
    """

    variance: Floats
    weight: float = math.inf
    window: float = math.inf
    rho: float = 1.0
    iterations: int = 0


class Drive(NamedTuple):
    """What solo filters run over, of all N vehicles, and which of them have one.

    Attributes:
        gnss: (R, T, N, 3) m, NaN for no fix and for an absent vehicle.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle.
        process: (R, T, N, 3) m^2, variance of a step's motion beside that of `motion`.
        motion: process noise that follows the measured velocity.
        columns: (E,) of the vehicles.
        dt: s.
    """

    gnss: Floats
    velocity: Floats
    process: Floats
    motion: MotionNoise
    columns: Ints
    dt: float


@part
def revised(prior: Any, innovation: float, late: float, rule: FixNoise) -> Any:
    """Variance of a fix m^2, and its weight, after an innovation of a fix that has `late` m^2 more than others.

    Running mean: r <- r + (v^2 - p - r) / n (Mehra, IEEE TAC 15(2), 1970). Variational Bayes: n = 2 alpha,
    r = beta / alpha, and n r the fixed point of rho n_0 r_0 + (1 - k)^2 v^2 + (1 - k) p with k = p / (p + r) (Sarkka
    and Nummenmaa, IEEE TAC 54(3), 2009, section III). A late fix and the prediction share the motion since, so v does
    not hold it.
    """
    _, share, motion, noise, weight = prior
    p = share * noise + motion
    if rule.iterations == 0:
        weight = min(weight + 1.0, rule.window)
        return max(noise + (innovation * innovation - p - noise) / weight, LEAST), weight
    before, weight = noise, rule.rho * weight + 1.0
    for _ in range(rule.iterations):
        rest = 1.0 - p / (p + noise + late)
        sample = rest * innovation * rest * innovation + rest * p
        noise = max(before + (sample - before) / weight, LEAST)
    return noise, weight


@part
def corrected(x: float, p: float, fix: float, r: float) -> Any:
    """Kalman update of one axis: k = p / (p + r), x += k (z - x), p = (1 - k)^2 p + k^2 r (Joseph)."""
    k = p / (p + r)
    return x + k * (fix - x), (1.0 - k) * (1.0 - k) * p + k * k * r


@part
def advance(state: Any, moved: float, process: float, fix: float, late: float, rule: FixNoise) -> Any:
    """One axis one step on: predict x += dt u, p += q; where there is a fix, revise its noise and correct."""
    x, share, motion, noise, weight = state
    x, motion = x + moved, motion + process
    if math.isnan(fix):
        return x, share, motion, noise, weight
    if math.isinf(weight):
        x, motion = corrected(x, motion, fix, noise + late)
        return x, 0.0, motion, noise, weight
    noise, weight = revised((x, share, motion, noise, weight), fix - x, late, rule)
    p = share * noise + motion
    k = p / (p + noise + late)
    rest = (1.0 - k) * (1.0 - k)
    return x + k * (fix - x), rest * share + k * k, rest * motion + k * k * late, noise, weight


@part
def begin(x: float, late: float, known: bool, variance: float, rule: FixNoise) -> Any:
    """State at a position that is known exactly, or as uncertain as a fix."""
    if known:
        return x, 0.0, 0.0, variance, rule.weight
    if math.isinf(rule.weight):
        return x, 0.0, variance + late, variance, rule.weight
    return x, 1.0, late, variance, rule.weight


@compiled
def drive(seen: Drive, rule: FixNoise, known: bool, places: AnyArray, x: AnyArray, p: AnyArray) -> AnyArray:
    """Fill x m and p m^2 at the places of the vehicles, and return the believed variance of a fix at each step, if it
    is revised.

    A vehicle that was absent starts at its first fix.

    Args:
        seen: the vehicles and their measurements.
        rule: noise of the fixes.
        known: whether x[:, 0] is given and exact; if not, it is a fix.
        places: (E,) of the vehicles in x and p.
        x: (R, T, N or E, 3).
        p: the same.
    """
    if math.isinf(rule.weight):
        _drive_known(seen, rule, known, places, x, p)
        return np.empty((0, 0, 0, 3))
    runs, steps, vehicles = seen.gnss.shape[0], seen.gnss.shape[1], len(seen.columns)
    noise, states = np.empty(x.shape), np.empty((vehicles, 3, 5))
    for run in range(runs):
        for t in range(steps):
            for e in range(vehicles):
                n, to = seen.columns[e], places[e]
                q = process_variance(seen.motion, seen.velocity[run, t, n], seen.dt)
                for c in range(3):
                    fix, now = seen.gnss[run, t, n, c], states[e, c]
                    moved = seen.dt * seen.velocity[run, t, n, c]
                    if t == 0:
                        state = begin(x[run, 0, to, c] if known else fix, 0.0, known, rule.variance[c], rule)
                    elif math.isnan(now[0] + moved):
                        state = begin(fix, 0.0, False, rule.variance[c], rule)
                    else:
                        before = now[0], now[1], now[2], now[3], now[4]
                        state = advance(before, moved, seen.process[run, t, n, c] + q[c], fix, 0.0, rule)
                    put(states[e], c, state)
                    x[run, t, to, c], p[run, t, to, c] = state[0], state[1] * state[3] + state[2]
                    noise[run, t, to, c] = state[3]
    return noise


@part
def _drive_known(seen: Drive, rule: FixNoise, known: bool, places: AnyArray, x: AnyArray, p: AnyArray) -> None:
    """`drive` with known noise of the fixes, where x and p are all of the state."""
    runs, steps, vehicles = seen.gnss.shape[0], seen.gnss.shape[1], len(seen.columns)
    for run in range(runs):
        for e in range(vehicles):
            for c in range(3):
                p[run, 0, places[e], c] = 0.0 if known else rule.variance[c]
                if not known:
                    x[run, 0, places[e], c] = seen.gnss[run, 0, seen.columns[e], c]
        for t in range(1, steps):
            for e in range(vehicles):
                n, to = seen.columns[e], places[e]
                q = process_variance(seen.motion, seen.velocity[run, t, n], seen.dt)
                for c in range(3):
                    fix, r = seen.gnss[run, t, n, c], rule.variance[c]
                    prior = x[run, t - 1, to, c] + seen.dt * seen.velocity[run, t, n, c]
                    variance = p[run, t - 1, to, c]
                    if math.isnan(prior):
                        prior, variance = fix, r
                    else:
                        variance += seen.process[run, t, n, c] + q[c]
                        if not math.isnan(fix):
                            prior, variance = corrected(prior, variance, fix, r)
                    x[run, t, to, c], p[run, t, to, c] = prior, variance


def packed(motion: MotionNoise, rule: FixNoise) -> Floats:
    """Both noises as one array: a tuple of arrays takes longer to hand over than a step takes."""
    return np.concatenate([motion.base, motion.ratio, motion[2:], rule.variance, rule[1:]])


@part
def dead_reckon(
    given: AnyArray, history: AnyArray, motion: MotionNoise, step: Any, q: AnyArray, moved: AnyArray, late: AnyArray
) -> int:
    """Add a step to the history: its motion and the variance of that; what a fix of some age has missed since.

    Nothing is changed where the input is bad or the history full. NO_FIX_YET: there is no fix.
    """
    dt, age, missing = given[DT], given[FIX_AGE], 0
    for c in range(3):
        missing += math.isnan(given[c])
        if math.isinf(given[c]) or not math.isfinite(given[3 + c]):
            return BAD_INPUT
    if not (dt > 0.0 and math.isfinite(dt)) or missing % 3 != 0:
        return BAD_INPUT
    if history[0, 1] + 1 >= len(history) - 1:
        return HISTORY_FULL
    variance = process_variance(motion, given[VELOCITY], dt)
    for c in range(3):
        q[c], step[c] = variance[c], dt * given[3 + c]
    first, count, seen = history[0, 0], history[0, 1], history[0, 2]
    push(history, dt, step[:3], q)
    if missing > 0:
        return NO_FIX_YET
    if not -ROUNDING <= age <= history[0, 2] + ROUNDING:
        history[0, 0], history[0, 1], history[0, 2] = first, count, seen
        return BAD_INPUT
    since(history, age, moved, late)
    return ESTIMATE


@compiled
def stream_step(given: AnyArray, state: AnyArray, history: AnyArray, noise: AnyArray, answer: AnyArray) -> int:
    """One step of a stream: dead reckoning, the fix brought forward, every axis one step on.

    Nothing is changed where the input is bad or the history full. A state of NaN has not started yet.

    Args:
        given: (8,) fix m, velocity m/s, dt s, age of the fix s.
        state: (3, 5).
        noise: of `packed`.
        answer: (12,) position m, covariance m^2.
    """
    motion = MotionNoise(noise[:3], noise[3:6], noise[6], noise[7], noise[8])
    rule = FixNoise(noise[9:12], noise[12], noise[13], noise[14], int(noise[15]))
    q, late, moved = np.empty(3), np.zeros(3), np.zeros(3)
    found = dead_reckon(given, history, motion, answer, q, moved, late)
    if found != ESTIMATE and found != NO_FIX_YET:
        return found
    if math.isnan(state[0, 0]):
        if found == NO_FIX_YET:
            return found
        for c in range(3):
            put(state, c, begin(given[c] + moved[c], late[c], False, rule.variance[c], rule))
    else:
        for c in range(3):
            one = state[c, 0], state[c, 1], state[c, 2], state[c, 3], state[c, 4]
            put(state, c, advance(one, answer[c], q[c], given[c] + moved[c], late[c], rule))
    answer[:] = 0.0
    for c in range(3):
        answer[c], answer[3 + 4 * c] = state[c, 0], state[c, 1] * state[c, 3] + state[c, 2]
    return ESTIMATE


@part
def put(state: AnyArray, c: int, values: Any) -> None:
    """Write the state of one axis."""
    state[c, 0], state[c, 1], state[c, 2], state[c, 3], state[c, 4] = values
