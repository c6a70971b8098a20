"""Solo Kalman filters on position, axis by axis, with known or adaptively estimated noise of the fixes.

The state of an axis is (x, share, motion, noise, weight, hits, before, spread, evidence, since): its position m, whose
variance is share * noise + motion m^2, where `noise` m^2 is the variance of a fix as it is estimated now and `weight`
the number of fixes behind that estimate; `hits` are those of fixes beyond the gate, and the rest is the position that
`gate.remember` is about, m, its variance m^2, and the memory of that; all but these two are the same on all axes.
With an infinite weight the noise is known, and the filter is the Kalman filter, whose variance is all in `motion`.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, inside, part
from .compiling.small import load, store
from .dead_reckoning import BAD_INPUT, ESTIMATE, NO_FIX_YET, dead_reckon
from .gate import BACK, BEGIN, HARD_REJECT_FACTOR, KEEP, NOTHING, SLIP, count, inflation, remember
from .motion import MotionNoise

LEAST = 1e-4
"""m^2, least variance of a fix: 1 cm."""
NEVER = (0.0, 0.0, 0.0)
"""m^2, what fixes that are not late have more."""
AxisState: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
STATE: AxisState = (0.0,) * 7 + (NOTHING, 0.0, 0.0)
"""Before the first fix; its length is the count that `load` takes."""
Vector: TypeAlias = tuple[float, float, float]
Gated: TypeAlias = tuple[float, float, float, float, float, float]


class FixNoise(NamedTuple):
    """The noise of fixes: known, or estimated as a running mean.

    Attributes:
        variance: (3,) m^2 at the start.
        weight: fixes that the start counts for; infinite: known.
        window: most fixes in the running mean.
        gate: squared normalised innovation of a fix from which it weighs less; 0 for none.
    """

    variance: Floats
    weight: float = math.inf
    window: float = math.inf
    gate: float = 0.0


class SoloMeasurements(NamedTuple):
    """Measurements of all N vehicles, and which of them have a solo filter.

    Attributes:
        gnss: (R, T, N, 3) m, NaN for no fix and for an absent vehicle.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle.
        process: (R, T, E, 3) m^2, variance of a step's motion.
        columns: (E,) of the vehicles.
        dt: s.
    """

    gnss: Floats
    velocity: Floats
    process: Floats
    columns: Ints
    dt: float


@inside
def start_state(x: float, late: float, exact: bool, variance: float, weight: float) -> AxisState:
    """State at a position that is known exactly, or as uncertain as a fix."""
    if exact:
        return x, 0.0, 0.0, variance, weight, 0.0, 0.0, NOTHING, 0.0, 0.0
    share = 0.0 if math.isinf(weight) else 1.0
    return x, share, (1.0 - share) * variance + late, variance, weight, 0.0, 0.0, NOTHING, 0.0, 0.0


@inside
def gate_fix(states: Floats, moved: Vector, process: Vector, fix: Vector, late: Vector, gate: float) -> Gated:
    """Squared normalised innovation of the axes' fix, its factor of their noise, and the hits that follow; what becomes
    of the position that is remembered, and its evidence and time."""
    q, other, gain, apart, spread, hits = 0.0, 0.0, 0.0, 0.0, 0.0, states[0, 5]
    if gate == 0.0:
        return q, 1.0, hits, KEEP, 0.0, 0.0
    for c in range(3):
        innovation = fix[c] - states[c, 0] - moved[c]
        if not math.isnan(innovation):
            s = (states[c, 1] + 1.0) * states[c, 3] + states[c, 2] + process[c] + late[c]
            q += innovation * innovation / (s + SLIP)
    if q <= gate and hits == 0.0 and states[0, 7] >= NOTHING:
        return q, 1.0, 0.0, KEEP, 0.0, 0.0
    for c in range(3):
        gap, p = states[c, 6] - states[c, 0], states[c, 7] + process[c]
        apart, spread = apart + gap * gap, spread + p
        if not math.isnan(fix[c]):
            innovation = fix[c] - states[c, 6] - moved[c]
            other += innovation * innovation / (p + states[c, 3] + late[c] + SLIP)
            p = states[c, 1] * states[c, 3] + states[c, 2] + process[c]
            gain += p / (3.0 * (p + states[c, 3] + late[c]))
    what, evidence, since = remember(q, other, gate, gain, apart, spread, states[0, 8], states[0, 9])
    if what == BACK:
        return other, 1.0, 0.0, what, 0.0, 0.0
    return q, inflation(q, gate, hits), count(q, gate, hits, gain), what, evidence, since


@inside
def step(
    state: AxisState, moved: float, process: float, fix: float, late: float, rule: FixNoise, gated: Gated
) -> AxisState:
    """Predict x += dt u, p += q; where there is a fix z, estimate its noise r and update in Joseph's form.

    The running mean r <- r + (v^2 - p - r) / n of innovations v (Mehra, IEEE TAC 15(2), 1970) leaves out `late` m^2,
    what a late fix has more: it and the prediction share the motion since; a v that is rejected counts as the largest
    one that is not.
    x += k (z - x), k = p / (p + f r), p = (1 - k)^2 p + k^2 f r.
    """
    (x, share, motion, noise, weight, _, before, spread, _, _), (q, f, hits, what, evidence, since) = state, gated
    x, motion, before, spread = x + moved, motion + process, before + moved, spread + process
    if what == BEGIN:
        before, spread = x, share * noise + motion
    elif what != KEEP:
        if what == BACK:
            x, share, motion = before, 0.0, spread
        spread = NOTHING
    noise_known = math.isinf(weight)
    if not math.isnan(fix):
        p, innovation = share * noise + motion, fix - x
        if not noise_known:
            weight = min(weight + 1.0, rule.window)
            within = min(1.0, HARD_REJECT_FACTOR * rule.gate / q) if f > 1.0 else 1.0
            noise = max(noise + (within * innovation * innovation - p - noise) / weight, LEAST)
            p = share * noise + motion
        if not math.isinf(f):
            k = p / (p + f * (noise + late))
            x, rest, own = x + k * innovation, (1.0 - k) * (1.0 - k), k * k * f
            if noise_known:
                motion = rest * p + own * (noise + late)
            else:
                share, motion = rest * share + own, rest * motion + own * late
    return x, share, motion, noise, weight, hits, before, spread, evidence, since


@compiled
def run_filter(
    measurements: SoloMeasurements, rule: FixNoise, exact: bool, index: Ints, x: Floats, p: Floats
) -> Floats:
    """Fill x m and p m^2 of the vehicles, and return the variance of each fix, where it is estimated or gated.

    A vehicle that was absent starts at its first fix.

    Args:
        measurements: the vehicles and their measurements.
        rule: noise of the fixes.
        exact: whether x[:, 0] is given and exact; if not, it is a fix.
        index: (E,) of the vehicles in x and p.
        x: (R, T, E or N, 3).
        p: the same.
    """
    varies = math.isfinite(rule.weight) or rule.gate > 0.0
    noise, states = np.empty(x.shape if varies else (0, 0, 0, 3)), np.empty((len(measurements.columns), 3, len(STATE)))
    filter_runs(measurements, rule, exact, index, states, x, p, noise)
    return noise


@part
def filter_runs(
    measurements: SoloMeasurements,
    rule: FixNoise,
    exact: bool,
    index: Ints,
    states: Floats,
    x: Floats,
    p: Floats,
    noise: Floats,
) -> None:
    """`run_filter` in given memory."""
    adaptive, varies = math.isfinite(rule.weight), len(noise) > 0
    for run in range(measurements.gnss.shape[0]):
        for t in range(measurements.gnss.shape[1]):
            for e in range(len(measurements.columns)):
                n, at = measurements.columns[e], index[e]
                u, q = measurements.velocity[run, t, n], three(measurements.process[run, t, e])
                fix = three(measurements.gnss[run, t, n])
                moved = measurements.dt * u[0], measurements.dt * u[1], measurements.dt * u[2]
                gated = gate_fix(states[e], moved, q, fix, NEVER, rule.gate if t > 0 else 0.0)
                for c in range(3):
                    if t == 0 and exact:
                        state = start_state(x[run, 0, at, c], 0.0, True, rule.variance[c], rule.weight)
                    elif t == 0 or math.isnan(states[e, c, 0] + moved[c]):
                        state = start_state(fix[c], 0.0, False, rule.variance[c], rule.weight)
                    else:
                        state = step(load(states[e, c], 0, STATE), moved[c], q[c], fix[c], 0.0, rule, gated)
                    store(states[e, c], 0, state)
                    x[run, t, at, c], p[run, t, at, c] = state[0], state[1] * state[3] + state[2]
                    if varies:
                        noise[run, t, at, c] = state[3] if adaptive else state[3] * gated[1]


@compiled
def stream_step(row: Floats, state: Floats, history: Floats, noise: Floats, answer: Floats) -> int:
    """One step of a stream: dead reckoning, the fix brought forward, `step` on every axis.

    Nothing is changed where the input is bad. A state of NaN has not started yet.

    Args:
        row: (8,) fix m, velocity m/s, dt s, age of the fix s.
        state: (3, 10).
        history: of `motion`.
        noise: (15,) the numbers of a MotionNoise and a FixNoise: to hand over tuples takes longer than the step.
        answer: (12,) position m, covariance m^2.
    """
    motion = MotionNoise(noise[:3], noise[3:6], noise[6], noise[7], noise[8])
    rule = FixNoise(noise[9:12], noise[12], noise[13], noise[14])
    q, late, moved = np.empty(3), np.zeros(3), np.zeros(3)
    outcome = dead_reckon(row, history, motion, answer, q, moved, late)
    starts = math.isnan(state[0, 0])
    if outcome == BAD_INPUT or (starts and outcome == NO_FIX_YET):
        return outcome
    fix = row[0] + moved[0], row[1] + moved[1], row[2] + moved[2]
    gated = gate_fix(state, three(answer), three(q), fix, three(late), rule.gate)
    for c in range(3):
        if starts:
            store(state[c], 0, start_state(fix[c], late[c], False, rule.variance[c], rule.weight))
        else:
            store(state[c], 0, step(load(state[c], 0, STATE), answer[c], q[c], fix[c], late[c], rule, gated))
    answer[:] = 0.0
    for c in range(3):
        answer[c], answer[3 + 4 * c] = state[c, 0], state[c, 1] * state[c, 3] + state[c, 2]
    return ESTIMATE


@inside
def three(values: Floats) -> Vector:
    """The first numbers of an array."""
    return values[0], values[1], values[2]
