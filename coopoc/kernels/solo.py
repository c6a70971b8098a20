"""The solo Kalman filter on position, axis by axis.

Its state is the votes of `gate.vote`, four vectors, position m and variance m^2 of each axis and those of the position
that `gate.remember` is about, the hits of fixes beyond the gate, and the evidence and the time of that memory.
"""

from math import inf, isinf, isnan
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from .compiling.compile import compiled, inside
from .compiling.small import add, inner_product, load, normalised_square, over, scale, store, subtract, times
from .dead_reckoning import BAD_INPUT, ESTIMATE, NO_FIX_YET, dead_reckon
from .gate import BACK, BEGIN, CONFIRMED, KEEP, NOT_REMEMBERED_M2, SLIP_M2, Vector, count, inflation, remember, vote
from .motion import MotionNoise

X, P, BEFORE, SPREAD, MEMORY = range(3, 8)
"""Numbers of the vectors in a state, behind the votes."""
OURS, POSITION, HITS, EVIDENCE, SINCE = 7, slice(9, 12), 21, 22, 23
"""Places in a state."""
ROW, NOWHERE = (0.0,) * 3, (NOT_REMEMBERED_M2,) * 3
STATE = ROW * 2 + (0.0, CONFIRMED, 0.0) + ROW * 3 + NOWHERE + ROW
"""At a position that is known."""


class FixNoise(NamedTuple):
    """The noise of fixes.

    Attributes:
        variance: (3,) m^2.
        gate: squared normalised innovation of a fix from which it weighs less; 0 for none.
    """

    variance: Floats
    gate: float = 0.0


class SoloMeasurements(NamedTuple):
    """Measurements of all N vehicles, and which of them have a solo filter.

    Attributes:
        gnss: (R, T, N, 3) m, NaN for no fix and for an absent vehicle.
        velocity: (R, T, N, 3) m/s, NaN for an absent vehicle.
        process: (R, T, E, 3) m^2, variance of a step's motion.
        fixes: (T, E, 3) m^2, variance of a fix.
        columns: (E,) of the vehicles.
        dt: s.
    """

    gnss: Floats
    velocity: Floats
    process: Floats
    fixes: Floats
    columns: Ints
    dt: float


@inside
def begin(state: Floats, x: Vector, variance: Vector, votes: float) -> None:
    """Begin at a position m of a variance m^2, with which so many fixes agree."""
    store(state, 0, STATE)
    store(state, 0, x)
    store(state, X, x)
    store(state, P, variance)
    state[OURS] = votes


@inside
def off(state: Floats, k: int, moved: Vector, fix: Vector, noise: Vector) -> float:
    """Squared normalised distance of a fix from the position that is vector k, before it is moved."""
    gap, slip = subtract(subtract(fix, load(state, k, ROW)), moved), (SLIP_M2, SLIP_M2, SLIP_M2)
    return 0.0 if isnan(fix[0]) else normalised_square(gap, add(add(load(state, k + 1, ROW), noise), slip))


@inside
def gate_fix(state: Floats, moved: Vector, process: Vector, fix: Vector, noise: Vector, gate: float) -> float:
    """Factor of the variance `noise` of a fix. The filter may go back to the position that is remembered, or leave a
    start that fixes outvote."""
    if state[OURS] < CONFIRMED:
        votes, left = vote(load(state, 0, STATE[:9]), moved, process, fix, noise)
        store(state, 0, votes)
        if left > 0.0:
            store(state, X, subtract(fix, moved))
            store(state, P, noise)
            store(state, MEMORY, ROW)
            return inf
    q, hits = off(state, X, moved, fix, noise), state[HITS]
    if q <= gate and hits == 0.0 and state[3 * SPREAD] >= NOT_REMEMBERED_M2:
        return 1.0
    x, p, before, spread = load(state, X, ROW), load(state, P, ROW), load(state, BEFORE, ROW), load(state, SPREAD, ROW)
    gain = 0.0 if isnan(fix[0]) else sum(times(p, over(add(p, noise)))) / 3.0
    gap, other = subtract(before, x), off(state, BEFORE, moved, fix, noise)
    apart, evidence, since = inner_product(gap, gap), state[EVIDENCE], state[SINCE]
    what, state[EVIDENCE], state[SINCE] = remember(q, other, gate, gain, apart, sum(spread), evidence, since)
    if what == BEGIN:
        store(state, BEFORE, x)
        store(state, SPREAD, p)
    elif what != KEEP:
        store(state, SPREAD, NOWHERE)
    state[HITS] = count(q, gate, hits, gain)
    if what == BACK:
        store(state, X, before)
        store(state, P, spread)
        state[HITS] = 0.0
        return 1.0
    factor: float = inflation(q, gate, hits)
    return factor


@inside
def step(state: Floats, moved: Vector, process: Vector, fix: Vector, noise: Vector, gate: float) -> float:
    """Predict x += dt u, p += q; where there is a fix z of variance r, update in Joseph's form; the fix's factor f.

    x += k (z - x), k = p / (p + f r), p = (1 - k)^2 p + k^2 f r.
    """
    for k in (P, SPREAD):
        store(state, k, add(load(state, k, ROW), process))
    f = gate_fix(state, moved, process, fix, noise, gate) if gate > 0.0 else 1.0
    for k in (X, BEFORE):
        store(state, k, add(load(state, k, ROW), moved))
    for c in range(3):
        if not (isnan(fix[c]) or isinf(f)):
            x, p = state[3 * X + c], state[3 * P + c]
            k = p / (p + f * noise[c])
            state[3 * X + c] = x + k * (fix[c] - x)
            state[3 * P + c] = (1.0 - k) * (1.0 - k) * p + k * k * f * noise[c]
    return f


@compiled
def run_filter(measurements: SoloMeasurements, gate: float, exact: bool, index: Ints, x: Floats, p: Floats) -> Floats:
    """Fill x m and p m^2 of the vehicles, and return the variance of each fix, where it is gated.

    A vehicle that was absent starts at its first fix.

    Args:
        measurements: the vehicles and their measurements.
        gate: of the fixes, as of FixNoise.
        exact: whether x[:, 0] is given and exact; if not, it is a fix.
        index: (E,) of the vehicles in x and p.
        x: (R, T, E or N, 3).
        p: the same.
    """
    noise = np.empty(x.shape if gate > 0.0 else (0, 0, 0, 3))
    states = np.empty((len(measurements.columns), len(STATE)))
    for run in range(measurements.gnss.shape[0]):
        for t in range(measurements.gnss.shape[1]):
            for e in range(len(measurements.columns)):
                n, at, state, f = measurements.columns[e], index[e], states[e], 1.0
                moved = scale(three(measurements.velocity[run, t, n]), measurements.dt)
                q = three(measurements.process[run, t, e])
                fix, r = three(measurements.gnss[run, t, n]), three(measurements.fixes[t, e])
                if t == 0 and exact:
                    begin(state, three(x[run, 0, at]), ROW, CONFIRMED)
                elif t == 0 or isnan(state[3 * X] + moved[0]):
                    begin(state, fix, r, 1.0)
                else:
                    f = step(state, moved, q, fix, r, gate)
                store(x[run, t, at], 0, load(state, X, ROW))
                store(p[run, t, at], 0, load(state, P, ROW))
                if len(noise):
                    store(noise[run, t, at], 0, scale(r, f))
    return noise


@compiled
def stream_step(row: Floats, state: Floats, history: Floats, odometry: Floats, noise: Floats, answer: Floats) -> int:
    """One step of a stream: dead reckoning, the fix brought forward, `step`.

    Nothing is changed where the input is bad. A state of NaN has not started yet.

    Args:
        row: (8,) fix m, velocity m/s, dt s, age of the fix s.
        state: (24,).
        history: of `motion`.
        odometry: of `dead_reckon`.
        noise: (13,) the numbers of a MotionNoise and a FixNoise: to hand over tuples takes longer than the step.
        answer: (12,) position m, covariance m^2.
    """
    motion = MotionNoise(noise[:3], noise[3:6], noise[6], noise[7], noise[8])
    q, late, moved, by_fixes = np.empty(3), np.zeros(3), np.zeros(3), np.zeros(4)
    outcome = dead_reckon(row, history, motion, noise[9:12], odometry, answer, q, moved, late, by_fixes)
    starts = isnan(state[3 * X])
    if outcome == BAD_INPUT or (starts and outcome == NO_FIX_YET):
        return outcome
    fix, r = add(three(row), three(moved)), add(three(noise[9:]), three(late))
    if starts:
        begin(state, fix, r, 1.0)
    else:
        step(state, three(answer), three(q), fix, r, noise[12])
    answer[:] = 0.0
    for c in range(3):
        answer[c], answer[3 + 4 * c] = state[3 * X + c], state[3 * P + c]
    return ESTIMATE


@inside
def three(values: Floats) -> Vector:
    """The first numbers of an array."""
    return values[0], values[1], values[2]
