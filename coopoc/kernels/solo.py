"""Solo Kalman filters on position, axis by axis, with known or adaptively estimated noise of the fixes.

The state of an axis is (x, share, motion, noise, weight): its position m, whose variance is share * noise + motion m^2,
where `noise` m^2 is the variance of a fix as it is estimated now and `weight` the number of fixes behind that estimate.
With an infinite weight the noise is known, and the filter is the Kalman filter, whose variance is all in `motion`.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, part
from .dead_reckoning import BAD_INPUT, ESTIMATE, NO_FIX_YET, dead_reckon
from .motion import MotionNoise, process_variance

LEAST = 1e-4
"""m^2, least variance of a fix: 1 cm."""
AxisState: TypeAlias = tuple[float, float, float, float, float]


class FixNoise(NamedTuple):
    """The noise of fixes: known, or estimated as a running mean.

    Attributes:
        variance: (3,) m^2 at the start.
        weight: fixes that the start counts for; infinite: known.
        window: most fixes in the running mean.
    """

    variance: Floats
    weight: float = math.inf
    window: float = math.inf


class SoloMeasurements(NamedTuple):
    """Measurements of all N vehicles, and which of them have a solo filter.

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
def start_state(x: float, late: float, exact: bool, variance: float, weight: float) -> AxisState:
    """State at a position that is known exactly, or as uncertain as a fix."""
    if exact:
        return x, 0.0, 0.0, variance, weight
    if math.isinf(weight):
        return x, 0.0, variance + late, variance, weight
    return x, 1.0, late, variance, weight


@part
def step(state: AxisState, moved: float, process: float, fix: float, late: float, window: float) -> AxisState:
    """Predict x += dt u, p += q; where there is a fix z, estimate its noise r and update in Joseph's form.

    The running mean r <- r + (v^2 - p - r) / n of innovations v (Mehra, IEEE TAC 15(2), 1970) leaves out `late` m^2,
    what a late fix has more: it and the prediction share the motion since. x += k (z - x), k = p / (p + r),
    p = (1 - k)^2 p + k^2 r.
    """
    x, share, motion, noise, weight = state
    x, motion = x + moved, motion + process
    if math.isnan(fix):
        return x, share, motion, noise, weight
    p, innovation = share * noise + motion, fix - x
    if math.isinf(weight):
        k = p / (p + noise + late)
        return x + k * innovation, 0.0, (1.0 - k) * (1.0 - k) * p + k * k * (noise + late), noise, weight
    weight = min(weight + 1.0, window)
    noise = max(noise + (innovation * innovation - p - noise) / weight, LEAST)
    p = share * noise + motion
    k = p / (p + noise + late)
    rest = (1.0 - k) * (1.0 - k)
    return x + k * innovation, rest * share + k * k, rest * motion + k * k * late, noise, weight


@compiled
def run_filter(seen: SoloMeasurements, rule: FixNoise, known: bool, index: Ints, x: Floats, p: Floats) -> Floats:
    """Fill x m and p m^2 of the vehicles, and return the estimated variance of a fix at each step, if it is estimated.

    A vehicle that was absent starts at its first fix.

    Args:
        seen: the vehicles and their measurements.
        rule: noise of the fixes.
        known: whether x[:, 0] is given and exact; if not, it is a fix.
        index: (E,) of the vehicles in x and p.
        x: (R, T, E or N, 3).
        p: the same.
    """
    runs, steps, vehicles = seen.gnss.shape[0], seen.gnss.shape[1], len(seen.columns)
    adaptive = math.isfinite(rule.weight)
    noise, states = np.empty(x.shape if adaptive else (0, 0, 0, 3)), np.empty((vehicles, 3, 5))
    for run in range(runs):
        for t in range(steps):
            for e in range(vehicles):
                n, at = seen.columns[e], index[e]
                q = process_variance(seen.motion, seen.velocity[run, t, n], seen.dt)
                for c in range(3):
                    fix, now = seen.gnss[run, t, n, c], states[e, c]
                    moved = seen.dt * seen.velocity[run, t, n, c]
                    if t == 0 and known:
                        state = start_state(x[run, 0, at, c], 0.0, True, rule.variance[c], rule.weight)
                    elif t == 0 or math.isnan(now[0] + moved):
                        state = start_state(fix, 0.0, False, rule.variance[c], rule.weight)
                    else:
                        before = now[0], now[1], now[2], now[3], now[4]
                        state = step(before, moved, seen.process[run, t, n, c] + q[c], fix, 0.0, rule.window)
                    put(now, state)
                    x[run, t, at, c], p[run, t, at, c] = state[0], state[1] * state[3] + state[2]
                    if adaptive:
                        noise[run, t, at, c] = state[3]
    return noise


def packed(motion: MotionNoise, rule: FixNoise) -> Floats:
    """Both noises as one array: a tuple of arrays takes longer to hand over than a step takes."""
    return np.concatenate([motion.base, motion.ratio, motion[2:], rule.variance, rule[1:]])


@compiled
def stream_step(given: Floats, state: Floats, history: Floats, noise: Floats, answer: Floats) -> int:
    """One step of a stream: dead reckoning, the fix brought forward, `step` on every axis.

    Nothing is changed where the input is bad. A state of NaN has not started yet.

    Args:
        given: (8,) fix m, velocity m/s, dt s, age of the fix s.
        state: (3, 5).
        history: of `motion`.
        noise: of `packed`.
        answer: (12,) position m, covariance m^2.
    """
    motion = MotionNoise(noise[:3], noise[3:6], noise[6], noise[7], noise[8])
    rule = FixNoise(noise[9:12], noise[12], noise[13])
    q, late, moved = np.empty(3), np.zeros(3), np.zeros(3)
    outcome = dead_reckon(given, history, motion, answer, q, moved, late)
    starts = math.isnan(state[0, 0])
    if outcome == BAD_INPUT or (starts and outcome == NO_FIX_YET):
        return outcome
    for c in range(3):
        now, fix = state[c], given[c] + moved[c]
        if starts:
            put(now, start_state(fix, late[c], False, rule.variance[c], rule.weight))
        else:
            before = now[0], now[1], now[2], now[3], now[4]
            put(now, step(before, answer[c], q[c], fix, late[c], rule.window))
    answer[:] = 0.0
    for c in range(3):
        answer[c], answer[3 + 4 * c] = state[c, 0], state[c, 1] * state[c, 3] + state[c, 2]
    return ESTIMATE


@part
def put(state: Floats, values: AxisState) -> None:
    """Write the state of one axis."""
    for i in range(5):
        state[i] = values[i]
